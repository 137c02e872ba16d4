"""What a test record asks that the training records do not answer: ranges, levels between theirs, frequencies, a start."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import Nature
from estimators.diagnosis.ladder.steps import Step
from estimators.diagnosis.policy import Policy
from oed.data import Record


def _range(train: Sequence[Record], of: Callable[[Record], NDArray]) -> tuple[NDArray, NDArray]:
    """The least and the largest values of what is read of the training records, by column."""
    known = np.concatenate([of(r) for r in train])
    return np.nanmin(known, axis=0), np.nanmax(known, axis=0)


def outside(train: Sequence[Record], test: Record, policy: Policy) -> list[str]:
    """What the test record asks that no training record covered: ranges of inputs, outputs and their rates."""
    out = []
    for words, of, units in (
        ("input", lambda r: r.u, test.input_units), ("output", lambda r: r.y, test.output_units),
        ("rate of the input", lambda r: np.diff(r.u, axis=0), [f"{u}/sample" if u else "" for u in test.input_units]),
        ("rate of the output", lambda r: np.diff(r.y, axis=0), [f"{u}/sample" if u else "" for u in test.output_units]),
    ):  # fmt: skip
        low, high = _range(train, of)
        asked = of(test)
        share = np.mean((asked < low) | (asked > high), axis=0)
        for j in np.flatnonzero(share > policy.outside):
            number = f" {j + 1}" if len(low) > 1 else ""
            far = max(low[j] - np.nanmin(asked[:, j]), np.nanmax(asked[:, j]) - high[j])
            out.append(f"{100 * share[j]:.3g} % of the test record's samples leave the range of the {words}{number} that the training "
                       f"data cover ({f'{low[j]:.4g} to {high[j]:.4g} {units[j]}'.rstrip()}), by up to {f'{far:.3g} {units[j]}'.rstrip()}")  # fmt: skip
    return out + _between(train, test, policy) + _new_frequencies(train, test, policy)


ABOUT = 0.05
"""Share of a record, before and after a sample outside the range of the training data, that is left out with it: what it meets there, as
a tank that runs over, has begun before and is remembered after."""


def inside(train: Sequence[Record], test: Record) -> NDArray[np.bool_]:
    """(N,) samples of a test record about which it stays in the range of the training inputs and outputs; all, where those are few."""
    off = np.zeros(len(test), dtype=bool)
    for of in (lambda r: r.u, lambda r: r.y):
        low, high = _range(train, of)
        off |= np.any((of(test) < low) | (of(test) > high), axis=1)
    near = np.convolve(off, np.ones(2 * int(ABOUT * len(test)) + 1), mode="same") > 0.5
    return ~near if np.mean(near) < MOST else np.ones(len(test), dtype=bool)


OPENING, MOST = 0.1, 0.5
"""A test record began in a state of its own where so much of it, at its start, makes so much of the answer's squared error. What leaves
the range of the training data for so much of it is judged there too."""


def begun(test: Record, run: NDArray, skip: int) -> list[str]:
    """That a run from rest meets a test record which does not begin at rest: then the errors are those of its first samples."""
    n = int(OPENING * len(test))
    squares = np.nansum((test.y - run) ** 2, axis=1)
    share = squares[:n].sum() / (squares.sum() or 1.0)
    if skip or not n or not share > MOST:
        return []
    return [f"{100 * share:.0f} % of the squared error on the test record is made in its first {n} samples, as where it does not begin "
            f"at rest; --skip {n} (in Python skip={n}) lets these set the state and leaves them out"]  # fmt: skip


MOSTLY = 0.5
"""Share of a record's samples off all levels of an input from which on a curve of that input is a guess there."""
GAP = 0.05
"""Of the range of an input, from which on nothing says what a curve does between two of its levels."""


def _off_levels(train: Sequence[Record], test: Record, j: int) -> tuple[NDArray[np.bool_], float]:
    """(N,) samples whose input lies between the levels that the training data cover, and how far from the nearest is far."""
    levels, asked = np.unique(np.concatenate([r.u[:, j] for r in train])), test.u[:, j]
    if len(levels) < 2:
        return np.zeros(len(asked), dtype=bool), 0.0
    at, far = np.clip(np.searchsorted(levels, asked), 1, len(levels) - 1), GAP * float(np.ptp(levels))
    return np.minimum(asked - levels[at - 1], levels[at] - asked) > far, far


def curve_unknown(step: Step, train: Record, test: Record) -> bool:
    """Whether a step has a curve of an input that is mostly where no training sample says anything of it."""
    structure = getattr(step.answer, "structure", None)
    parts = () if structure is None else structure.effects
    curved = {
        q.channel for q in parts if q.effect.nature is Nature.INPUT_STATIC and q.effect.apply is not None
    }
    return any(np.mean(_off_levels([train], test, j)[0]) > MOSTLY for j in curved)


def _between(train: Sequence[Record], test: Record, policy: Policy) -> list[str]:
    """Inputs of the test record inside the training range and off all levels that it was sampled at."""
    out = []
    for j in range(test.n_inputs):
        off, far = _off_levels(train, test, j)
        share = float(np.mean(off))
        if share > policy.outside:
            number = f" {j + 1}" if test.n_inputs > 1 else ""
            out.append(f"{100 * share:.3g} % of the test record's samples lie between levels of the input{number} that the "
                       f"training data cover, more than {far:.4g} from the nearest: no curve is known there")  # fmt: skip
    return out


def _new_frequencies(train: Sequence[Record], test: Record, policy: Policy) -> list[str]:
    """Share of the test input's power at frequencies where the training input has next to none."""
    from scipy.signal import welch

    out = []
    size = min(256, len(test), *(len(r) for r in train))
    for j in range(test.n_inputs):
        power = np.mean([welch(r.u[:, j], nperseg=size)[1] for r in train], axis=0)
        asked = welch(test.u[:, j], nperseg=size)[1]
        share = float(np.sum(asked[power < policy.dark * asked]) / max(np.sum(asked), 1e-300))
        if share > policy.outside:
            out.append(f"{100 * share:.3g} % of the power of test input {j + 1} is at frequencies where the training input "
                       "has next to none")  # fmt: skip
    return out
