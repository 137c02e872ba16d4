"""Whether the input knows the noise: feedback, under which a regression on inputs would explain noise by its own echo."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.signal.windows import blackmanharris
from scipy.spatial import cKDTree
from scipy.stats import chi2

from estimators.diagnosis.baseline import Baseline
from estimators.residual.algebra import decomposed
from oed.data import Record

Array = NDArray[np.float64]
Design = tuple[Array, Array, Array]

ORDER = 10
"""Of the autoregressions that whiten: a noise that needs more is slow, and slow noise is no innovation."""
LATER = range(1, 21)
"""Samples by which an input may answer the noise."""
PAST = 30
"""Samples of its own past from which an input is predicted."""
MATTERS = 0.02
"""Share of an input's innovations that the noise must explain: a weaker loop echoes less noise than a block can tell."""
STILL = 12, range(1, 6)
"""Samples of its own past from which an input is predicted where its reference stands still, and by how many it may answer the noise.
Its own sample is none of them: there an output that hears its input at once looks the same, as means over a sample do."""
ANSWERS = 0.05
"""Share of what that past leaves between the jumps of an input's reference that this noise must explain: of records with a loop or
without one, .068 or more and .02 at most, where weather drives the output within the sample."""
OF_INPUT = 1e-3
"""Share of an input itself that answers the noise where a loop is told by it alone: loops have .016 and more, filtered records 1e-4."""
AGO, SLOW = (1, 2, 3, 4, 6, 8, 12, 16), (10.0, 30.0, 100.0)
"""Samples ago of bends, and time constants in samples of slow means: half octaves and half decades of what a past holds."""
ALIKE, APART = (1, 4, 16), 30
"""Most alike moments of an input's past whose next sample foretells it, and samples by which these lie off the present at least."""
BAND, EMPTY = 0.9, 1e-8
"""Share of the band above which an input that holds less than this share of its mean power there was filtered: no loop's noise ends so."""
ALPHA = 1e-4
"""False-alarm rate: with feedback only what improves the one-step prediction counts, a hard demand elsewhere."""
MOST_LEVER = 0.99
"""Leverage beyond which a sample's own weight in the fit is not divided out of its residual."""


def autoregression(signals: Sequence[Array], uses: Sequence[NDArray[np.bool_]]) -> Array:
    """(ORDER + 1,) whitening filter, leading 1, by least squares over records (N,) on the samples in use."""
    rows, targets = [], []
    for x, use in zip(signals, uses, strict=True):
        x = np.where(use, x, 0.0)
        lags = np.stack([np.concatenate((np.zeros(i), x[:-i])) for i in range(1, ORDER + 1)], axis=1)
        rows.append(lags[use])
        targets.append(x[use])
    A, b = np.concatenate(rows), np.concatenate(targets)
    ridge = 1e-9 * (float(b @ b) + 1e-300) * np.eye(ORDER)
    return np.concatenate(([1.0], -np.linalg.solve(A.T @ A + ridge, A.T @ b)))


def whitened(filter_: Array, x: Array) -> Array:
    """(N,) or (N, p) signals through a whitening filter, at rest at the first sample's level."""
    return np.asarray(lfilter(filter_, [1.0], x - x[0], axis=0)) + filter_.sum() * x[0]


def delayed(record: Record) -> Record:
    """The record with its inputs one sample late: under feedback the present input may hold the present noise."""
    return record.replace(u=np.concatenate((record.u[:1], record.u[:-1])))


def has_feedback(
    records: Sequence[Record], residual: Sequence[Array], uses: Sequence[NDArray[np.bool_]]
) -> bool:
    """Whether an input answers the noise, surely and by a share of it that matters."""
    clean, alpha = _clean(residual, uses), ALPHA / records[0].n_inputs

    def later(own: Array, lead: Array, target: Array) -> bool:
        return _gain(own, lead, target) > MATTERS and wald(own, lead, target) < alpha

    def still(own: Array, lead: Array, target: Array) -> bool:
        return _still(own, lead, target, alpha)

    heard = [j for j in range(records[0].n_inputs) if not any(filtered(r.u[:, j]) for r in records)]
    for told, reach in ((later, (PAST, LATER)), (still, STILL)):
        for j in heard:
            if all(told(*_design(records, clean, j, *reach, bends)) for bends in (False, True)):
                return True
    return False


def in_loop(records: Sequence[Record], base: Baseline, output: int) -> bool:
    """Whether an input answers what the linear model leaves of an output."""
    left = [r.y[:, output] - y[:, output] for r, y in zip(records, base.y_model, strict=True)]
    return has_feedback(records, left, [c[:, output] for c in base.blocks.counting(records)])


def is_answer(
    records: Sequence[Record], residual: Sequence[Array], uses: Sequence[NDArray[np.bool_]]
) -> bool:
    """Whether so much of an input is an answer to the noise that a closed loop is told by it.

    Of an input whose past leaves next to nothing of it, noise may foretell even that for another reason: who filtered both
    signals, with samples of later times, gave each some of the other's future.
    """
    clean = _clean(residual, uses)
    return any(
        _left(own, u) - _left(np.hstack((own, lead)), u) > OF_INPUT * float(u @ u)
        for reach in (STILL, (PAST, LATER))
        for own, lead, u in (_design(records, clean, j, *reach, True) for j in range(records[0].n_inputs))
    )


def _still(own: Array, lead: Array, target: Array, alpha: float) -> bool:
    """Whether an input answers the noise where its reference stands still: there it does nothing else."""
    rounding = 1e-7 * float(np.std(target))
    rows = between_jumps(own[:, : STILL[0]], target, rounding)
    design = own[rows], lead[rows], target[rows]
    moves = _left(own[rows], target[rows]) > rounding**2 * rows.sum()
    return moves and _gain(*design) > ANSWERS and wald(*design) < alpha


def between_jumps(own: Array, target: Array, rounding: float) -> NDArray[np.bool_]:
    """The samples of an input that are not far off what its own past (N, p) foretells: a reference's jumps are no noise.

    The first are those near the sample before: where jumps are many, a fit to all foretells none of them, nor what is between.
    """
    left, rows = target - own[:, 0], np.ones(len(target), dtype=bool)
    for _ in range(9):
        spread = 1.4826 * float(np.median(np.abs(left)))
        inside = np.abs(left) <= 4.0 * max(spread, rounding)
        if inside.sum() < 0.5 * len(rows) or np.array_equal(inside, rows):
            break
        rows = inside
        if spread <= rounding:
            break
        left = target - own @ decomposed(own[rows], target[rows])
    return rows


def answered(
    records: Sequence[Record], residual: Sequence[Array], uses: Sequence[NDArray[np.bool_]]
) -> float:
    """Share of the innovations of the input that answers the noise most, beyond what chance makes of it.

    Granger's test: past whitened residuals help to predict an input beyond the input's own past. An input may be
    predictable, as narrow-band ones are: only what its own past does not tell counts.
    """
    clean = _clean(residual, uses)
    designs = [_design(records, clean, j, PAST, LATER) for j in range(records[0].n_inputs)]
    return max(_gain(*d) for d in designs) - len(LATER) / len(designs[0][-1])


def filtered(x: Array) -> bool:
    """Whether nothing is left of an input (N,) near half the sampling rate.

    Who filters a record so, with samples of later times, gives each signal some of the other's future.
    """
    power = np.abs(np.fft.rfft((x - x.mean()) * blackmanharris(len(x)))) ** 2
    return bool(np.mean(power[int(BAND * len(power)) :]) < EMPTY * np.mean(power))


def beside(inputs: Array, j: int) -> Array:
    """(N, p) what may tell of input j of (N, nu) beyond lags of its own: bends and slow means of all, lags of the others, and what
    came next where the inputs went as now.

    A model's error is a bent function of past inputs: where an input may be told from such a one, the error tells of it with no loop.
    So is when a wave that a generator makes turns the next time.
    """
    size = inputs.std(axis=0)
    x = (inputs - inputs.mean(axis=0)) / np.where(size > 0, size, 1.0)
    columns = [_late(v**power - np.mean(v**power), i) for v in x.T for power in (2, 3) for i in AGO]
    poles = np.exp(-1.0 / np.array(SLOW))
    columns += [_late(np.asarray(lfilter([1.0 - z], [1.0, -z], v)), 1) for v in x.T for z in poles]
    columns += [_late(x[:, k], i) for k in range(x.shape[1]) if k != j for i in range(1, STILL[0] + 1)]
    return np.column_stack((*columns, _again(x, j)))


def _again(x: Array, j: int) -> Array:
    """(N, ALIKE) means of input j of (N, nu) after the moments at which the inputs' past was most like the present one."""
    n, many = len(x), ALIKE[-1]
    past = np.stack([_late(v, i) for v in x.T for i in AGO], axis=1)
    near = cKDTree(past).query(past, k=min(n, many + 2 * APART))[1].reshape(n, -1)
    apart = np.abs(near - np.arange(n)[:, None]) > APART
    rank = np.cumsum(apart, axis=1)
    means = [
        np.where(apart & (rank <= k), x[near, j], 0.0).sum(axis=1) / np.clip(rank[:, -1], 1, k) for k in ALIKE
    ]
    return np.stack(means, axis=1)


def _clean(residual: Sequence[Array], uses: Sequence[NDArray[np.bool_]]) -> list[Array]:
    """The noise of each record, whitened."""
    noise = autoregression(residual, uses)
    return [whitened(noise, np.where(c, e, 0.0)) * c for e, c in zip(residual, uses, strict=True)]


def _design(
    records: Sequence[Record], clean: Sequence[Array], j: int, past: int, leads: range, bends: bool = False
) -> Design:
    """Of an input, over all records, its own past (n, past), the noise so many samples before (n, leads) and the input (n,).

    With `bends` what its bends and the other inputs tell of it goes with its own past.
    """
    rows = []
    for r, e in zip(records, clean, strict=True):
        x = r.u[:, j] - r.u[:, j].mean()
        own = np.stack([_late(x, i) for i in range(1, past + 1)], axis=1)
        own = np.hstack((own, beside(r.u, j))) if bends else own
        lead = np.stack([_late(e, i) for i in leads], axis=1)
        rows.append((own[past:], lead[past:], x[past:]))
    own, lead, target = (np.concatenate(part) for part in zip(*rows, strict=True))
    return own, lead, target


def _gain(own: Array, lead: Array, target: Array) -> float:
    """Share of what the input's own past leaves of it that the noise explains."""
    return 1.0 - _left(np.hstack((own, lead)), target) / max(_left(own, target), 1e-300)


def wald(own: Array, lead: Array, target: Array) -> float:
    """p-value of 'the noise of samples before explains nothing of an input beyond its own past' by the variance of each sample's own residual (MacKinnon and White's HC3).

    An input of weather or of a driver is still by night and at rest: the test of equal variances takes its storms for answers.
    """
    size = np.sqrt(np.mean(own**2, axis=0))
    Q = np.linalg.qr(own / np.where(size > 0, size, 1.0))[0]
    X, b = lead - Q @ (Q.T @ lead), target - Q @ (Q.T @ target)
    G = np.linalg.pinv(X.T @ X, hermitian=True)
    theta = G @ (X.T @ b)
    lever = np.sum(Q**2, axis=1) + np.einsum("ij,jk,ik->i", X, G, X)
    scores = X * ((b - X @ theta) / (1.0 - np.minimum(lever, MOST_LEVER)))[:, None]
    V = np.linalg.pinv(G @ (scores.T @ scores) @ G, hermitian=True)
    return float(chi2.sf(theta @ V @ theta, lead.shape[1]))


def _late(x: Array, by: int) -> Array:
    return np.concatenate((np.zeros(by), x[: len(x) - by]))


def _left(A: Array, b: Array) -> float:
    """Sum of squares that least squares leaves."""
    size = np.sqrt(np.mean(A**2, axis=0))
    Z = A / np.where(size > 0, size, 1.0)
    rest = b - Z @ np.linalg.solve(Z.T @ Z + 1e-10 * len(b) * np.eye(Z.shape[1]), Z.T @ b)
    return float(rest @ rest)
