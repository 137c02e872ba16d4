"""How much of what the linear model leaves could be explained at all, from which variables, and of what nature."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Baseline
from estimators.diagnosis.share.feedback import autoregression, delayed, has_feedback, whitened
from estimators.diagnosis.share.interval import bounds
from estimators.diagnosis.share.news import NEWS, Predictor, directions, sized
from estimators.diagnosis.share.regression import Folds, Regression, folds_of
from estimators.diagnosis.share.signals import Columns, bank_of, columns_of
from estimators.residual.algebra import delayed as lagged
from estimators.residual.algebra import mean_error
from oed.covariances import NORMAL
from oed.data import Record

Array = NDArray[np.float64]

RESOLUTION = 2.0**-24
"""Of the output: what is smaller is rounding, which no converter resolves and in which nothing is explainable."""

ALONE: Mapping[str, tuple[str, ...]] = {
    "linear dynamics": ("linear",),
    "static input nonlinearity": ("linear", "input"),
    "static output nonlinearity": ("linear", "output"),
    "sampling": ("linear", "sampling"),
    "disturbance": ("linear", "trend", "disturbance"),
    "time variation": ("linear", "trend", "time"),
    "dynamic nonlinearity": ("linear", "dynamic", "output"),
}
"""Which columns a cause of each nature needs, the simplest nature first. The linear ones are in all: any cause bends the
best linear model too."""


@dataclass(frozen=True)
class Evidence:
    """What columns of one nature explain by themselves.

    `nature` in the words of the catalogue; `share, low, high` of the residual's variance on unused blocks,
    with a 95 % interval; `sentence` the same in words.
    """

    nature: str
    share: float
    low: float
    high: float
    sentence: str


@dataclass(frozen=True, eq=False)
class Share:
    """How much of one output's residual a fading-memory regression predicts on blocks that it did not see.

    `share` of the residual's variance that is predicted there, below zero where the regression only harms; `low, high`
    95 % interval of the share that can be explained, which is more than few samples and slow noise let a regression
    predict: from 0 on where it may be nothing, wide where the record says little; `predicted` 95 % interval of
    `share` itself, on which claims rest; `by` variable -> what is lost of the share without it; `natures` the most probable
    first; `noise_floor, noise_low, noise_high` root mean square of what nothing here explains: an upper bound
    of the noise, with its interval; `unused` per record (N,): the regression's prediction of the residual
    with the sample's block unused; NaN where no sample counts; `feedback` whether the input answers the
    noise: then residual and columns are whitened, and the shares are those of the one-step prediction, which
    feedback leaves honest; `news` standard errors by which that belongs beside a linear one-step prediction.
    """

    share: float
    low: float
    high: float
    by: dict[str, float]
    natures: tuple[Evidence, ...]
    noise_floor: float
    noise_low: float
    noise_high: float
    unused: tuple[Array, ...]
    feedback: bool = False
    news: float = np.inf
    predicted: tuple[float, float] = (0.0, 0.0)

    @property
    def explainable(self) -> bool:
        """Whether what is predicted is surely above zero, and it is news to a linear predictor: something other than noise is in it."""
        return self.predicted[0] > 0.0 and self.news > NEWS

    @property
    def nature(self) -> str:
        """The nature that the evidence puts first; noise where nothing is explainable."""
        return self.natures[0].nature if self.explainable and self.natures else "noise"

    @property
    def nothing(self) -> "Share":
        """The same of a residual in which only rounding is left."""
        return replace(self, share=0.0, low=0.0, high=0.0, by={}, natures=(), predicted=(0.0, 0.0))


def _taken(target: Array, left: Array) -> float:
    """1 - left^2 / target^2, of mean squares; nothing of nothing."""
    base = float(np.mean(target**2))
    return 1.0 - float(np.mean(left**2)) / base if base else 0.0


def _interval(target: Array, left: Array) -> tuple[float, float, float]:
    """The same with a 95 % interval of what these fits predict, from squares that have a memory."""
    share = _taken(target, left)
    if not (base := float(np.mean(target**2))):
        return 0.0, 0.0, 0.0
    error = NORMAL * mean_error((target**2 - left**2 - share * target**2) / base)
    return share, share - error, share + error


def explainable_share(base: Baseline, records: Sequence[Record], output: int = 0) -> Share:
    """The explainable share of one output's residual, by variable and by nature."""
    records = list(records)
    counts = [c[:, output] for c in base.blocks.counting(records)]
    residual = [r.y[:, output] - y[:, output] for r, y in zip(records, base.y_model, strict=True)]
    folds = folds_of(base.blocks)
    feedback = has_feedback(records, residual, counts)
    tables = _columns(base, [delayed(r) for r in records] if feedback else records, output)
    values = [t.values for t in tables]
    if feedback:
        noise = autoregression(residual, counts)
        residual = [whitened(noise, np.where(c, r, 0.0)) for r, c in zip(residual, counts, strict=True)]
        values = [whitened(noise, v) for v in values]
    regression = Regression.of(values, residual, counts, folds)
    kinds, variables = np.array(tables[0].kinds), np.array(tables[0].variables)
    everything = np.arange(len(kinds))
    groups = [everything, *(np.flatnonzero(np.isin(kinds, own)) for own in ALONE.values())]
    fits = [regression.unused(g) for g in groups]
    alone = dict(zip(ALONE, (f.predicted for f in fits[1:]), strict=True))
    best = min(fits, key=lambda f: f.error).predicted
    share, *predicted = _interval(regression.target, regression.target - best)
    spread = np.std(np.concatenate([r.y[c, output] for r, c in zip(records, counts, strict=True)]))
    if np.std(regression.target) > RESOLUTION * spread:
        gone = np.zeros((len(best), 0)) if feedback else _taken_out(base, records, counts, output)
        low, high = bounds(regression, fits, gone)
    else:  # rounding alone is left, and its squares may be no numbers
        share, low, high, predicted = 0.0, 0.0, 0.0, [0.0, 0.0]
    left = (regression.target - best) ** 2
    floor, error = float(left.mean()), NORMAL * mean_error(left)
    by = {
        str(v): share
        - _taken(
            regression.target, regression.target - regression.unused(everything[variables != v]).predicted
        )
        for v in dict.fromkeys(variables)
    }
    noise, least, most = (float(np.sqrt(max(x, 0.0))) for x in (floor, floor - error, floor + error))
    natures = _ranked(regression.target, alone, NORMAL if feedback else 1.0) if predicted[0] > 0 else ()
    unused, told = _spread(best, counts, folds), np.inf
    if predicted[0] > 0 and not feedback:  # there the shares are those of one-step predictions
        told = Predictor.of(records, base.y_model, output, counts).news(
            [y[:, output] + x for y, x in zip(base.y_model, unused, strict=True)]
        )
    return Share(
        share, low, high, by, natures, noise, least, most, unused, feedback, told, (predicted[0], predicted[1])
    )  # fmt: skip


def _taken_out(
    base: Baseline, records: Sequence[Record], counts: Sequence[NDArray[np.bool_]], output: int
) -> Array:
    """Orthonormal directions (M, k) in which the linear model's own fit leaves nothing: what its run does when a parameter moves."""
    model, inputs = base.outputs[output].model, base.outputs[output].inputs
    if model.radius >= 1.0:
        return np.zeros((sum(int(c.sum()) for c in counts), 0))
    tables = []
    for r, y, own in zip(records, base.y_model, counts, strict=True):
        columns = [np.eye(len(r), model.order)]
        columns += [lagged(y[:, [output]], range(1, model.order + 1))] if model.order else []
        columns += [
            lagged(r.u[:, [j]], np.flatnonzero(row))
            for j, row in zip(inputs, model.num, strict=True)
            if row.any()
        ]
        moved = np.asarray(lfilter([1.0], model.den, np.hstack(columns), axis=0))
        tables.append(np.column_stack((np.ones(len(r)), moved))[own])
    return directions(sized(np.concatenate(tables)))


def _columns(base: Baseline, records: list[Record], output: int) -> list[Columns]:
    bank = bank_of(base, records, output)
    start = records[0].t0
    return [
        columns_of(bank, r, y, output, (r.t0 - start) / r.dt)
        for r, y in zip(records, base.y_model, strict=True)
    ]


def _spread(values: Array, counts: Sequence[NDArray[np.bool_]], folds: Folds) -> tuple[Array, ...]:
    out, begin = [], 0
    for c, n in zip(counts, folds.lengths, strict=True):
        whole = np.full(n, np.nan)
        whole[c] = values[begin : begin + int(c.sum())]
        begin += int(c.sum())
        out.append(whole)
    return tuple(out)


def _ranked(target: Array, alone: Mapping[str, Array], errors: float) -> tuple[Evidence, ...]:
    """Natures in the order of their claim: the simplest that is within so many standard errors of the best comes first.

    Feedback biases the linear model itself, so that there the simplest has more of a claim.
    """
    rows = {n: _interval(target, target - f) for n, f in alone.items()}
    best = max(rows, key=lambda n: rows[n][0])

    def behind(nature: str) -> bool:
        gap = (target - alone[nature]) ** 2 - (target - alone[best]) ** 2
        return float(gap.mean()) > errors * mean_error(gap)

    order = [n for n in ALONE if not behind(n)] + sorted(
        (n for n in ALONE if behind(n)), key=lambda n: -rows[n][0]
    )
    return tuple(Evidence(n, *rows[n], _sentence(n, *rows[n])) for n in order)


def _sentence(nature: str, share: float, low: float, high: float) -> str:
    return (
        f"{nature.capitalize()} alone predicts {max(share, 0.0):.0%} ({low:.0%} to {high:.0%}) of the residual's variance "
        "on blocks that were not used."
    )
