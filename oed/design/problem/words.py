"""A design in words: what to apply, what it saves, how sure that is; then the evidence."""

from typing import TYPE_CHECKING

import numpy as np

from oed.criteria import NAMED
from oed.errors import Status

if TYPE_CHECKING:
    from oed.design.problem.design import Design

ASKED = dict.fromkeys(NAMED, "all parameters") | {
    "E": "the parameters' least known combination",
    "hinf": "the peak gain",
    "static-gain": "the static gain",
    "pole": "the modulus of the least damped pole",
    "damping": "the least damping of a pole",
    "I": "the response on average",
    "G": "the response where it is known worst",
    "Ds:": "the parameters {}",
    "gain:": "the gain at {} rad/sample",
    "pole:": "the modulus of pole {}",
    "damping:": "the damping of pole {}",
    "I:": "the response on average in {} rad/sample",
    "G:": "the response where it is known worst in {} rad/sample",
}
"""What a named criterion asks for, with an argument where a colon follows."""
MOST_NAMED = 4
"""Frequencies that the first sentence names: more are not read."""
SLIGHT = 1e-3
"""Share of the power below which a line is not worth naming."""
UNSEEN = 1e-5
"""A gap that no experiment could tell from none."""
SLOW = 1e-6
"""rad/sample below which a line is a constant to whoever applies it: it turns once in six million samples."""


def in_words(design: "Design") -> str:
    """A design as a reader sees it: the answer first."""
    lines = [
        headline(design),
        f"{design.criterion.name}: loss per sample {design.loss:.12g}, at least {design.bound:.12g} "
        f"for every admissible spectrum (gap {design.gap:.1e}{'' if design.status.ok else ', not closed'}); "
        f"white noise of the same power reaches {100 * design.efficiency_white:.4g} % of the optimum",
    ]
    share = np.einsum("kii->k", design.spectrum.power).real
    for w, P in zip(design.spectrum.omega, share, strict=True):
        hertz = "" if design.map.dt is None else f" = {w / (2 * np.pi * design.map.dt):.6g} Hz"
        lines.append(f"  {w:.9f} rad/sample{hertz}   power {P:.9g}")
    return "\n".join([*lines, *reservations(design), f"{design.status.name}: {design.status.value}"])


def headline(design: "Design") -> str:
    """What to apply, how many samples it saves against white noise, and what is certified."""
    return f"{question(design.criterion.name)}: {where(design)}; {against_white(design)}; {certified(design)}"


def question(criterion: str) -> str:
    """What the input is for: a named criterion in words, with its key."""
    key, colon, argument = criterion.partition(":")
    asked = ASKED.get(key + colon)
    return f"to learn {asked.format(argument.replace(':', ' to '))} ({key})" if asked else f"for {criterion}"


def where(design: "Design") -> str:
    """The frequencies to apply with their shares of the power, or the band that holds half of it."""
    dt = design.map.dt
    turn, unit = (1.0, "rad/sample") if dt in (None, 1.0) else (2 * np.pi * dt, "Hz")
    strong = design.spectrum.strongest(SLIGHT)
    omega, line = np.unique(strong.omega, return_inverse=True)
    share = np.bincount(line, np.einsum("kii->k", strong.power).real)
    share, at = share / share.sum(), omega / turn
    if len(at) <= MOST_NAMED:
        named = [f"{f:.4g} {unit}" if f * turn > SLOW else "a constant" for f in at]
        if len(named) == 1:
            return f"apply {named[0]} alone"
        parts = [f"{name} with {100 * p:.3g} %" for name, p in zip(named, share, strict=True)]
        return f"apply {', '.join(parts[:-1])} and {parts[-1]} of the power"
    low, high = at[np.searchsorted(np.cumsum(share), (0.25, 0.75))]
    return f"apply half of the power between {low:.4g} and {high:.4g} {unit}, most at {at[np.argmax(share)]:.4g} {unit}"


def against_white(design: "Design") -> str:
    """How many times the samples white noise of the same power would need; its loss where samples do not say it."""
    efficiency = design.efficiency_white * design.loss / design.bound
    if efficiency > 1 + UNSEEN:  # nothing within the limits can be better
        return "white noise of the same power does not keep the limits"
    if not efficiency > 0:
        return "white noise of the same power does not tell it"
    M, loss = design.information, design.criterion.loss
    if np.isclose(loss(2 * M), loss(M) / 2) and not design.map.constant.any():
        return f"white noise of the same power needs {1 / efficiency:.3g} times as many samples for the same error"
    return f"with white noise of the same power the loss is {1 / efficiency:.3g} times as large"


def certified(design: "Design") -> str:
    """What is proved of every other input within the limits."""
    scope = "of this grid" if design.certificate.elsewhere > 1 + 1e-6 else "within the limits"
    if design.status.ok and design.gap < UNSEEN:
        return f"certified: no input {scope} does better"
    sure = "certified" if design.status.ok else "not closed"
    return f"{sure}: an input {scope} may be up to {100 * design.gap:.2g} % better"


def reservations(design: "Design") -> list[str]:
    """What the bound does not cover, and what rounding hides."""
    lines = []
    if design.certificate.elsewhere > 1 + 1e-6:
        lines.append(
            f"the grid misses something: a line at {design.certificate.elsewhere_frequency:.6g} rad/sample is worth "
            f"{design.certificate.elsewhere:.4g} times its cost, so the bound holds on the grid only: "
            "give points there, or leave refine on"
        )
    if design.certificate.rounding > (
        design.gap if design.status is Status.INACCURATE else max(1e-7, design.gap)
    ):
        lines.append(
            f"rounding alone moves the loss by {design.certificate.rounding:.1e} of it: double precision hardly tells "
            "some parameters apart"
        )
    return lines
