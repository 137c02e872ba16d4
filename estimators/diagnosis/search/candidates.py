"""Every effect of the catalogue fitted on top of a model: the candidates of one round of attribution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.catalogue import CATALOGUE
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.layouts import allowed
from estimators.diagnosis.model.linear import fit_linear, layout_starts, prefiltered_error
from estimators.diagnosis.model.simulation import acted, free_responses
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.search.starts import Start, gains_of_shapes, shapes, tone_starts

__all__ = ["PLANT_EFFECTS", "STATIC_EFFECTS", "augmented", "refit"]

Array = NDArray[Any]

CURVES = ("sandwich", "input_lines", "output_lines")
"""Found corner by corner, not among the candidates (`estimators.diagnosis.search.blocks`)."""
STATIC_EFFECTS = tuple(
    k for k, e in CATALOGUE.items() if e.slot in ("input", "output") and k not in ("delay", "lag", *CURVES)
)
PLANT_EFFECTS = (
    "stiffness_cubic",
    "stiffness",
    "coulomb",
    "stribeck",
    "coulomb_asymmetric",
    "drag",
    "bilinear",
    "bilinear_driven",
    "stiffness_square",
    "stiffness_quintic",
    "stiffness_gap",
    "stiffness_upper",
    "stiffness_lower",
    "end_stop",
    "position_damping",
    "hysteretic_spring",
    "timescale_change",
    "damping_change",
    "pole_change",
)


REFINED = {  # tried only in the layout and after the success of a simpler effect that resembles them
    "stiffness_square": ("stiffness_cubic", "stiffness"),
    "stiffness_quintic": ("stiffness_cubic", "stiffness"),
    "stiffness_gap": ("stiffness_cubic", "stiffness"),
    "stiffness_upper": ("stiffness_cubic", "stiffness"),
    "stiffness_lower": ("stiffness_cubic", "stiffness"),
    "end_stop": ("stiffness_cubic", "stiffness"),
    "position_damping": ("drag", "stiffness_cubic"),
    "hysteretic_spring": ("coulomb", "drag"),
}
SHARE = 0.25  # of the best gain so far, that the simpler effect must have reached


def _best(fits: list[Fit]) -> Fit | None:
    fits = [f for f in fits if np.isfinite(f.deviance)]
    return min(fits, key=lambda f: f.deviance) if fits else None


def _grid(channel: Channel, base: Fit, part: Part, best: int) -> list[Start]:
    grid, sizes, amplitude = shapes(part.key, channel, base, part.channel)
    return gains_of_shapes(channel, base, part, grid, sizes, amplitude, best)


def _fits(channel: Channel, base: Fit, starts: list[Start], iterations: int) -> Fit | None:
    return _best(
        [fit(channel, s.structure, s.p, s.scales, noise=base.noise, iterations=iterations) for s in starts]
    )


def refit(channel: Channel, f: Fit, *, iterations: int = 15) -> Fit:
    """Fit again under the noise model that the last fit chose, until the two agree.

    Parameters
    ----------
    channel : Channel
        Data.
    f : Fit
        The fit.
    iterations : int
        Most Gauss-Newton steps per pass.

    Returns
    -------
    Fit
        The better of the passes by Schwarz's criterion.
    """
    if not len(f.noise):
        return f
    best = f
    for _ in range(3):
        again = fit(channel, f.structure, best.p, f.scales, noise=best.noise, iterations=iterations)
        if not np.isfinite(again.deviance) or again.criterion > best.criterion - 0.05:
            break
        best = again
    return best


def _delays(channel: Channel, base: Fit) -> Fit | None:
    s = base.structure
    if len(s.effects):
        return _fits(channel, base, _grid(channel, base, Part("delay", s.inputs[0]), 3), 20)
    if s.layout != "tf":
        return None
    best, worse = base, 0
    for d in (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25):
        if d > len(channel) // 10:
            break
        f = fit_linear(channel, replace(s, delay=d), noise=base.noise, extra=[best.p[: s.order]])
        if f.deviance < best.deviance:
            best, worse = f, 0
        else:
            worse += 1
            if worse >= 4:
                break
    fits = []
    for start in {max(best.structure.delay + x, 0.05) for x in (-0.5, 0.02, 0.5)}:
        source = best if best.structure.delay else base
        p = np.concatenate((source.p, [start]))
        new = replace(s, delay=0).adding(Part("delay", s.inputs[0]))
        fits.append(
            fit(channel, new, p, np.concatenate((source.scales, [1.0])), noise=base.noise, iterations=20)
        )
    return _best(fits)


def _initial(channel: Channel, base: Fit) -> Fit | None:
    s = base.structure
    if any(p.key == "initial" for p in s.parts):
        return None
    X = free_responses(s, base.p, len(channel))
    theta = np.linalg.lstsq(X[channel.keep], base.residual[channel.keep], rcond=None)[0]
    new = s.adding(Part("initial"))
    scales = np.concatenate((base.scales, np.abs(theta) + 0.1 * np.abs(theta).max() + 1e-300))
    return fit(channel, new, np.concatenate((base.p, theta)), scales, noise=base.noise)


def _path(channel: Channel, base: Fit, key: str, j: int, sizes: tuple[int, ...]) -> Fit | None:
    fits = []
    residual = Channel(channel.u, base.residual, channel.clock, channel.keep, 0.0)
    for size in sizes:
        f = fit_linear(residual, Structure(size, (j,)))
        p = np.concatenate((base.p, f.p[size:], f.p[:size]))
        new = base.structure.adding(Part(key, j, size))
        scales = np.concatenate((base.scales, f.scales[size:], f.scales[:size]))
        fits.append(fit(channel, new, p, scales, noise=base.noise))
    fits = [f for f in fits if np.isfinite(f.deviance)]
    return min(fits, key=lambda f: f.criterion) if fits else None


def _changed_gain(channel: Channel, base: Fit, j: int) -> Start | None:
    """A gain that changes, from linear fits with one numerator before and one after: the poles of one linear model
    for the whole record may be far off, and with them the time at which its score is best."""
    s = base.structure
    if s.layout != "tf" or s.effects or len(s.inputs) != 1:
        return None
    k, n = channel.clock.k, len(channel)
    y = channel.y - np.mean(channel.y[channel.keep]) if s.parts else channel.y

    def inputs(time: float) -> Array:
        return np.stack([channel.u[:, j], channel.u[:, j] * (k >= time)], axis=1)

    den = np.concatenate(([1.0], base.p[: s.order]))
    rows = channel.keep.copy()
    rows[: s.order + s.delay] = False

    def squares(time: float) -> float:
        return prefiltered_error(y, inputs(time), den, s, rows)

    times = k[0] + np.linspace(0.06, 0.94, 23) * n
    time = float(min(times, key=squares))
    near = time + np.linspace(-0.035, 0.035, 15) * n
    time = float(min(near, key=squares))
    two = Channel(inputs(time), channel.y, channel.clock, channel.keep, channel.step)
    f = fit_linear(two, replace(s, inputs=(0, 1)), extra=[base.p[: s.order]])
    b = f.p[s.order : s.order + 2 * s.taps].reshape(2, s.taps)
    change = float(b[0] @ b[1]) / (float(b[0] @ b[0]) + 1e-300)
    p = np.concatenate((f.p[: s.order], b[0], f.p[s.order + 2 * s.taps :], [change, time]))
    return Start(s.adding(Part("gain_change", j)), p, np.concatenate((base.scales, [1.0, 1.0])), 0.0)


def _ringing(channel: Channel, base: Fit) -> Start | None:
    """A sinusoid in place of poles that ring through the whole record: a linear model may have taken it for a mode."""
    s = base.structure
    if s.layout != "tf" or s.effects or s.order < 3:
        return None
    poles = np.roots(np.concatenate(([1.0], base.p[: s.order])))
    ringing = [z for z in poles if z.imag > 0 and abs(z) > 1.0 - 3.0 / len(channel)]
    if not ringing:
        return None
    w = float(np.angle(max(ringing, key=abs)))
    k = channel.clock.k
    X = np.stack([np.cos(w * k), np.sin(w * k)], axis=1)
    c = np.linalg.lstsq(X[channel.keep], channel.y[channel.keep], rcond=None)[0]
    linear = fit_linear(replace(channel, y=channel.y - X @ c), s)
    size = float(np.std(channel.y)) + 1e-300
    return Start(
        s.adding(Part("tones", 0, 1)),
        np.concatenate((linear.p, [w], c)),
        np.concatenate((linear.scales, [1.0 / len(channel), size, size])),
        0.0,
    )


def _higher_order(channel: Channel, base: Fit, key: str, extra: int) -> Fit | None:
    """More poles; beside effects that act on the input, from a linear fit to what they make of it."""
    s = base.structure
    if s.layout != "tf" or any(part.effect.slot != "input" for part in s.effects):
        return None
    wide = replace(s, order=s.order + extra, taps=s.taps + extra, parts=s.parts[: s.base])
    if not s.effects:
        f = fit_linear(channel, wide, noise=base.noise)
        return replace(f, structure=f.structure.adding(Part(key, 0, extra)))
    entering = acted(s, base.p, channel.u, channel.clock)
    if entering is None:
        return None
    f = fit_linear(replace(channel, u=entering), replace(wide, inputs=tuple(range(len(s.inputs)))))
    start = s.slices()[s.base].start
    p, scales = np.concatenate((f.p, base.p[start:])), np.concatenate((f.scales, base.scales[start:]))
    return fit(channel, replace(wide, parts=(*s.parts, Part(key, 0, extra))), p, scales, noise=base.noise)


def augmented(
    channel: Channel, base: Fit, *, only: set[str] | None = None, best: int = 2, iterations: int = 25,
    others: tuple[int, ...] = (), top: int = 0,
) -> Iterator[Fit]:  # fmt: skip
    """Fits of the model with each further effect of the catalogue.

    Parameters
    ----------
    channel : Channel
        Data.
    base : Fit
        The model that the effects are added to.
    only : set of str, optional
        Keys to try; by default all that fit the structure.
    best : int
        Starts per effect.
    iterations : int
        Gauss-Newton steps per start.
    others : tuple of int
        Inputs that do not act on this output in the model, for missing cross-coupling.
    top : int
        Fit only this many of the effects whose scores promise most; 0 for all.

    Yields
    ------
    Fit
        One fit per effect and input, the best of its starts.
    """
    s = base.structure
    present = {p.key for p in s.parts}
    labels = {p.effect.label for p in s.effects}
    wanted = [
        k
        for k, e in CATALOGUE.items()
        if (only is None or k in only) and k not in present and e.label not in labels
    ]
    scored: list[tuple[float, list[Start], str]] = []
    for key in wanted:
        if key in STATIC_EFFECTS or key in ("offset", "drift", "step_output", "lag"):
            for j in s.inputs if CATALOGUE[key].slot == "input" else s.inputs[:1]:
                starts = _grid(channel, base, Part(key, j), best)
                if key == "gain_change" and starts and (more := _changed_gain(channel, base, j)) is not None:
                    starts = [*starts, more]
                if starts:
                    scored.append((starts[0].promise, starts, key))
        elif key not in PLANT_EFFECTS and key not in CURVES:
            for found in _special(channel, base, key, others):
                if found is not None and np.isfinite(found.deviance):
                    yield found
    plant = [k for k in PLANT_EFFECTS if k in wanted]
    layouts = _layouts(channel, base) if plant and len(s.inputs) == 1 else []
    gains = [0.0]  # of all effects fitted so far
    if layouts:
        for layout in layouts:
            for key in (k for k in plant if k not in REFINED):
                if allowed(key, layout.structure.layout):
                    starts = _grid(channel, layout, Part(key, s.inputs[0]), best)
                    if starts:
                        scored.append((starts[0].promise + base.deviance - layout.deviance, starts, key))
    scored.sort(key=lambda task: -task[0])
    keys: list[str] = []
    for promise, _, key in scored:
        if key not in keys and (not top or (len(keys) < top and promise > 6.0)):
            keys.append(key)
    for key in (k for k in keys if k not in PLANT_EFFECTS):
        for _, starts, name in scored:
            if name == key:
                found = _fits(channel, base, starts, iterations)
                if found is not None:
                    gains.append(base.deviance - found.deviance)
                    yield found
    simple: dict[str, Fit] = {}
    for found in _plant_fits(channel, base, [k for k in PLANT_EFFECTS if k in keys], scored, iterations):
        gains.append(base.deviance - found.deviance)
        simple[found.structure.parts[-1].key] = found
        yield found
    yield from _refined_fits(
        channel, base, [k for k in plant if k in REFINED], simple, layouts, max(gains), iterations
    )


def _refined_fits(
    channel: Channel, base: Fit, keys: list[str], simple: dict[str, Fit], layouts: list[Fit], most: float,
    iterations: int,
) -> Iterator[Fit]:  # fmt: skip
    """Relatives of an effect inside the plant that did well, in the layout where it did."""
    for key in keys:
        parents = [simple[k] for k in REFINED[key] if k in simple]
        parents = [f for f in parents if base.deviance - f.deviance > max(SHARE * most, 10.0)]
        if not parents:
            continue
        near = min(parents, key=lambda f: f.deviance).structure.layout
        for layout in layouts:
            if layout.structure.layout == near and allowed(key, near):
                starts = _grid(channel, layout, Part(key, layout.structure.inputs[0]), 2)
                quick = [f for start in starts if (f := _fits(channel, base, [start], 5)) is not None]
                best = _best(quick)
                if best is not None:
                    yield fit(
                        channel, best.structure, best.p, best.scales, noise=best.noise, iterations=iterations
                    )
                break


def _special(channel: Channel, base: Fit, key: str, others: tuple[int, ...]) -> Iterator[Fit | None]:
    """Effects whose starts are not a grid of shapes."""
    s = base.structure
    if key == "tones":
        fits = []
        for count in (1, 2, 3):
            start = tone_starts(channel, base, count)
            if start is not None:
                fits.append(
                    fit(channel, start.structure, start.p, start.scales, noise=base.noise, iterations=15)
                )
            if len(fits) > 1 and fits[-1].criterion > fits[-2].criterion:
                break
        start = _ringing(channel, base)
        if start is not None:
            fits.append(fit(channel, start.structure, start.p, start.scales, noise=base.noise, iterations=25))
        fits = [f for f in fits if np.isfinite(f.deviance)]
        yield min(fits, key=lambda f: f.criterion) if fits else None
    elif key == "initial":
        yield _initial(channel, base)
    elif key == "delay":
        yield _delays(channel, base)
    elif key == "mode" and s.effects:
        yield _path(channel, base, key, s.inputs[0], (2,))
    elif key == "delay_order":
        if s.layout == "tf" and not s.effects and not s.delay:
            fits = []
            for order, delay in ((s.order + 1, 2), (s.order + 1, 3), (s.order + 2, 2), (s.order + 2, 3)):
                if order - delay >= 1:
                    new = replace(s, order=order, taps=order - delay, delay=delay)
                    f = fit_linear(channel, new, noise=base.noise)
                    fits.append(replace(f, structure=f.structure.adding(Part(key))))
            fits = [f for f in fits if np.isfinite(f.deviance)]
            yield min(fits, key=lambda f: f.criterion) if fits else None
    elif key in ("order", "order_one"):
        yield _higher_order(channel, base, key, 2 if key == "order" else 1)
    elif key == "cross":
        for j in others:
            yield _path(channel, base, key, j, (1, 2))


def _layouts(channel: Channel, base: Fit) -> list[Fit]:
    """The model in the physical layouts of its order."""
    s = base.structure
    if s.layout != "tf":
        return [base]
    fits = [
        fit(channel, new, p, scales, noise=base.noise, iterations=8, colour=False)
        for new, p, scales in layout_starts(channel, base)
    ]
    return [f for f in fits if np.isfinite(f.deviance)]


def _plant_fits(
    channel: Channel,
    base: Fit,
    keys: list[str],
    scored: list[tuple[float, list[Start], str]],
    iterations: int,
) -> Iterator[Fit]:
    """Effects inside the plant: a few steps in each layout, then the best is fitted to the end."""
    dry: Fit | None = None
    for key in keys:
        refined = key in ("stribeck", "coulomb_asymmetric")
        if refined and dry is not None and base.deviance - dry.deviance < 6.0:
            continue
        mine = [start for _, starts, name in scored if name == key for start in starts]
        quick = [f for start in mine if (f := _fits(channel, base, [start], 5)) is not None]
        if refined and dry is not None:  # also from where plain dry friction ended
            for start in mine:
                if start.structure.layout == dry.structure.layout:
                    size = 2 if key == "stribeck" else 1
                    p = np.concatenate((dry.p, start.p[-size:]))
                    f = fit(channel, start.structure, p, start.scales, noise=base.noise, iterations=8)
                    quick += [f] if np.isfinite(f.deviance) else []
        if not quick:
            continue
        quick.sort(key=lambda f: f.deviance)
        if base.deviance - quick[0].deviance < -30.0:
            continue
        found = _best(
            [
                fit(channel, f.structure, f.p, f.scales, noise=f.noise, iterations=iterations)
                for f in quick[:2]
            ]
        )
        if found is None:
            continue
        if key == "coulomb_asymmetric" and dry is not None and found.deviance < dry.deviance - 3.0:
            plain = replace(
                found.structure, parts=(*base.structure.parts, Part("coulomb", found.structure.inputs[0]))
            )
            again = fit(
                channel, plain, found.p[:-1], found.scales[:-1], noise=base.noise, iterations=iterations
            )
            if again.deviance < dry.deviance:
                dry = again
                yield again
        if key == "coulomb":
            dry = found
        yield found
