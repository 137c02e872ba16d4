"""Choosing a delay and orders: the same model fitted with each, compared by a criterion that is stated."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimators.stages import stage
from oed.covariances import of_few
from oed.data import Record, frozen
from oed.errors import InputError, OedError
from oed.files.objects import as_records
from oed.models.structures import ORDERS, STRUCTURES

if TYPE_CHECKING:
    from estimators.pem.fit import Fit

NEAR = 10.0
"""Difference of AIC up to which a delay is looked at closely: beyond it the best is 150 times as likely."""

WORTH = 0.01
"""What one more order must take off the error on blocks left out: less is within what five blocks can tell apart, and
nobody would see it in a plot."""
PATIENCE, MOST = 2, 8
"""Orders tried without a gain before the climb ends (a resonance needs two), and where it ends at the latest."""
FOLDS, OPENING = 5, 0.25
"""Blocks left out in turn, and the share of each that sets its initial state and is left out of its error."""
SURE = 3.0
"""Standard errors by which a tap of the impulse response must differ from zero to end the delay: one in 400 does by chance."""
LOOK, LATEST = 4, 12
"""Order of the regression that gives a first delay, and the longest that it tries."""


@dataclass(frozen=True, eq=False)
class Delay:
    """The delay under which a model fits best. `delay` nk with the smallest loss; `delays` those tried;
    `loss` mean square of the residual for each; NaN where the model could not be fitted; `weights`
    exp(-difference of AIC / 2), normalised: how the data weigh the delays against each other; `fit` the model
    with that delay."""

    delay: int
    delays: NDArray[np.int64]
    loss: NDArray[np.float64]
    weights: NDArray[np.float64]
    fit: Fit

    def to_dict(self) -> dict:
        """Plain numbers."""
        return {"delay": self.delay} | {x: getattr(self, x).tolist() for x in ("delays", "loss", "weights")}

    def __repr__(self) -> str:
        rows = ", ".join(f"{k}: {v:.4g}" for k, v in zip(self.delays, self.loss, strict=True))
        return f"delay {self.delay} (weight {self.weights.max():.3g}); loss by delay {rows}"


def estimate_delay(
    records: Record | Sequence[Record], structure: str = "oe", orders: Any = (2, 2), *,
    delays: Iterable[int] = range(9), **options: Any,
) -> Delay:  # fmt: skip
    """The delay nk under which a structure of given orders leaves the smallest residual. All candidates have
    the same number of parameters, so that the loss alone decides: it is the profile likelihood of the delay.
    Every candidate is fitted with the quick search; those that come near the best are fitted once more with
    the search that was asked for."""
    from estimators.pem import identify

    tried = sorted({int(nk) for nk in delays})
    fits: dict[int, Fit] = {}
    for k, nk in enumerate(tried):
        stage("delays", k, len(tried))
        try:
            fits[nk] = identify(records, structure, orders, nk, **{**options, "search": "quick"})
        except OedError:
            if nk == tried[-1] and not fits:
                raise
    if not fits:
        raise InputError(f"no delay of {tried} gives a model that can be fitted; lower the orders.")
    best_aic = min(fit.aic for fit in fits.values())
    for nk, found in fits.items():
        if found.aic < best_aic + NEAR and options.get("search") != "quick":
            fits[nk] = identify(records, structure, orders, nk, **options)
    loss = np.array([fits[nk].loss if nk in fits else np.nan for nk in tried])
    aic = np.array([fits[nk].aic if nk in fits else np.inf for nk in tried])
    weights = np.exp(-(aic - aic.min()) / 2)
    best = tried[int(np.nanargmin(loss))]
    return Delay(best, frozen(tried, int), frozen(loss), frozen(weights / weights.sum()), fits[best])


@dataclass(frozen=True, eq=False)
class Choice:
    """Models of several orders, best first. `criterion` bic, aic or cv; `rows` orders, delay, n, value of the
    criterion, loss, status; sorted by the criterion; `fit` the best model, fitted to all data."""

    criterion: str
    rows: tuple[dict, ...]
    fit: Fit

    @property
    def orders(self) -> tuple[int, ...]:
        """Orders of the best model."""
        return self.rows[0]["orders"]

    def to_dict(self) -> dict:
        """Plain numbers."""
        return {"criterion": self.criterion, "rows": [dict(row) for row in self.rows]}

    def __repr__(self) -> str:
        head = f"orders by {self.criterion}: {self.orders} with delay {self.rows[0]['delay']}"
        told = "  {orders!s:>16} nk {delay}: {value:.6g} (loss {loss:.5g}, {status})"
        return "\n".join([head, *(told.format(**row) for row in self.rows[:10])])


def select_orders(
    records: Record | Sequence[Record], structure: str, orders: Iterable[Sequence[int]] | Sequence[Iterable[int]],
    *, delays: Iterable[int] = (1,), criterion: str = "bic", folds: int = 5, **options: Any,
) -> Choice:  # fmt: skip
    """Fit models of many orders and rank them."""
    from estimators.pem import identify

    if criterion not in ("aic", "bic", "cv"):
        raise InputError(f"the criterion is {criterion!r}; choose aic, bic or cv.")
    given = list(orders)
    tuples: list[tuple[int, ...]] = (
        [tuple(map(int, o)) for o in itertools.product(*given)]  # type: ignore[arg-type]
        if any(isinstance(o, range) for o in given)
        else [tuple(map(int, o)) for o in given]  # type: ignore[arg-type]
    )
    rows, fits, first_error = [], {}, None
    models = list(itertools.product(tuples, delays))
    for k, (chosen, nk) in enumerate(models):
        stage("models", k, len(models))
        try:
            fit = identify(records, structure, chosen, nk, **options)
            value = (
                _left_out(records, structure, chosen, nk, folds, options)
                if criterion == "cv"
                else float(getattr(fit, criterion))
            )
        except OedError as error:
            first_error = first_error or error
            continue
        fits[chosen, nk] = fit
        told = {"value": value, "loss": fit.loss, "status": fit.status.name}
        rows.append({"orders": chosen, "delay": int(nk), "n": fit.model.structure.n} | told)
    if not rows:
        raise InputError(f"none of {len(tuples)} orders could be fitted; the first said: {first_error}")
    rows.sort(key=lambda row: (row["value"], row["n"]))
    return Choice(criterion, tuple(rows), fits[rows[0]["orders"], rows[0]["delay"]])


def automatic(
    records: Record | Sequence[Record], structure: str, orders: Any, delay: Any, **options: Any
) -> Fit:
    """The model whose orders, delay or both are "auto". Orders climb together from the smallest while that
    lowers the simulation error on blocks left out; the smallest that is nearly the best is taken. The delay
    is that of a linear regression first, and that of the model itself in the end."""
    from estimators.pem import identify

    for name, value in (("orders", orders), ("delay", delay)):
        if isinstance(value, str) and value != "auto":
            raise InputError(f"{name} is {value!r}; give whole numbers, or 'auto'.")
    if structure not in ORDERS:
        raise InputError(f"the structure {structure!r} has no orders to choose; take {', '.join(ORDERS)}.")
    given = as_records(records, missing=bool(options.get("missing")))
    nk, notes = delay, []
    if delay == "auto":
        nk = 1 if structure == "ss" else _first_delay(given)
    if orders == "auto":
        rows = _climb(given, structure, nk, {**options, "search": "quick"})
        best = min(error for _, error in rows)
        orders = next(tried for tried, error in rows if error <= best * (1 + WORTH))
        listed = ", ".join(f"{tried} {error:.4g}" for tried, error in rows)
        notes = [f"orders {orders}, the fewest whose error on blocks left out is near the best: {listed}"]
    if delay == "auto" and structure != "ss":
        fit = estimate_delay(given, structure, orders, delays=range(max(nk - 1, 0), nk + 2), **options).fit
    else:
        fit = identify(given, structure, orders, nk, **options)
    return replace(fit, notes=(*fit.notes, *notes))


def _climb(
    given: list[Record], structure: str, nk: int, options: dict
) -> list[tuple[tuple[int, ...], float]]:
    """Orders from the smallest, each with its simulation error on blocks left out, until no more is gained; then fewer poles, until
    that costs: of several inputs the one that comes latest sets how far all numerators reach, and poles that follow them there
    cancel, anywhere, so that no gain is told."""
    rows: list[tuple[tuple[int, ...], float]] = []
    said = ""
    window = int(OPENING * (len(given[0]) // FOLDS if len(given) == 1 else min(map(len, given))))
    error_of = lambda orders: held_out_error(
        given, structure, orders, nk, folds=FOLDS, window=window, **options
    )[0]
    for k in range(1, MOST + 1):
        stage("orders, at most", k - 1, MOST)
        orders = (k * (1 if structure == "ss" else STRUCTURES[structure].step),) * len(ORDERS[structure])
        try:
            error = error_of(orders)
        except OedError as refused:  # too short a record, or more than it can tell; or too small to be told (a noise of one pole)
            said = said or str(refused)
            if rows:
                break
            continue
        rows.append((orders, error))
        if len(rows) - int(np.argmin([e for _, e in rows])) > PATIENCE:
            break
    if not rows:
        raise InputError(f"not even the smallest {structure} model can be fitted: {said}")
    best = min(error for _, error in rows)
    orders, error = next(row for row in rows if row[1] <= best * (1 + WORTH))
    poles = [name in ("na", "nf") for name in ORDERS[structure]]
    fewer: list[tuple[tuple[int, ...], float]] = []
    while any(poles) and min(orders) > 1 and error <= best * (1 + WORTH):
        orders = tuple(n - one for n, one in zip(orders, poles, strict=True))
        try:
            error = error_of(orders)
        except OedError:
            break
        fewer.insert(0, (orders, error))
    return [*fewer, *rows]


def _first_delay(given: list[Record]) -> int:
    """The longest delay under which a linear regression on lagged signals is nearly as good as under any."""
    first = LOOK + LATEST
    now, past = [], []
    for r in given:
        now.append(r.y[first:])
        lags = [r.y[first - k : len(r) - k] for k in range(1, LOOK + 1)]
        past.append((np.hstack(lags), [r.u[first - k : len(r) - k] for k in range(first)]))
    if sum(map(len, now)) < 2 * first:
        raise InputError(
            f"the record is too short to choose a delay; give it, or more than {3 * first} samples."
        )
    y, own = np.concatenate(now), np.concatenate([own for own, _ in past])
    rest = []
    for nk in range(LATEST + 1):
        lagged = np.concatenate([np.hstack(inputs[nk : nk + LOOK]) for _, inputs in past])
        A = np.hstack([own, lagged, np.ones((len(y), 1))])
        good = np.isfinite(A).all(axis=1) & np.isfinite(y).all(axis=1)
        e = y[good] - A[good] @ np.linalg.lstsq(A[good], y[good], rcond=None)[0]
        rest.append(float(np.sqrt(np.mean(e**2))))
    return max(nk for nk, value in enumerate(rest) if value <= min(rest) * (1 + WORTH))


def from_records(records: Sequence[Record]) -> Fit:
    """Output-error model of which nothing is given: delays by the first sure tap of every impulse response, one order for all
    entries by the Bayesian criterion, from the smallest until no more is gained. Records from rest, without offset."""
    from estimators.norm.fir import plug_in
    from estimators.pem import identify

    def tried(order: int, nk: NDArray) -> Fit | None:
        orders = (order, order) if nk.size == 1 else (np.full(nk.shape, order).tolist(),) * 2
        delay = nk.tolist() if nk.size > 1 else int(nk[0, 0])
        try:
            return identify(records, "oe", orders, delay, search="quick", offset=False)
        except OedError as error:
            said.append(str(error))
            return None

    said: list[str] = []
    response = plug_in(records)
    n, _, nu = response.taps.shape
    spread = np.sqrt(np.diag(response.covariance)).reshape(n, 1, nu) * np.sqrt(response.noise)[:, None]
    sure = np.abs(response.taps[: LATEST + 1]) > SURE * spread[: LATEST + 1]
    nk = np.where(sure.any(axis=0), sure.argmax(axis=0), 1)
    found: dict[int, Fit] = {}
    best = 0
    for order in range(1, MOST + 1):
        fit = tried(order, nk)
        if fit is not None:
            found[order] = fit
            best = min(found, key=lambda k: found[k].bic)
        if order > best > 0 or order > PATIENCE > best:  # a higher order that is no better ends it
            break
    if not found:
        raise InputError(f"no order could be fitted; the first said: {said[0]}")
    beside = [tried(best, nk + step) for step in (-1, 1) if nk.size == 1 and nk.min() + step >= 0]
    return min([found[best], *filter(None, beside)], key=lambda fit: fit.bic)


def _blocks(given: list[Record], folds: int) -> list[tuple[list[Record], Record]]:
    """What is fitted and what is left out: one of several records, or one block of a single one."""
    if len(given) > 1:
        return [([r for r in given if r is not left], left) for left in given]
    edges = np.linspace(0, len(given[0]), folds + 1).astype(int)
    blocks = []
    for a, b in itertools.pairwise(edges):
        rest = [given[0][s:e] for s, e in ((0, a), (b, len(given[0]))) if e - s > 1]
        blocks.append((rest, given[0][a:b]))
    return blocks


def held_out_error(
    records: Record | Sequence[Record], structure: str, orders: Any, delay: Any = 1, *,
    folds: int = 4, window: int = 0, **options: Any,
) -> tuple[float, float]:  # fmt: skip
    """Simulation error on blocks left out in turn: what decides between structures without fresh data."""
    from estimators.pem import identify

    given = as_records(records, missing=bool(options.get("missing")))
    if len(given) == 1 and not 2 <= folds <= len(given[0]) // 2:
        raise InputError(
            f"folds is {folds} for {len(given[0])} samples; take 2 or more, of 2 samples or more."
        )
    squares, counts = [], []
    for rest, left in _blocks(given, folds):
        if not 0 <= window < len(left):
            raise InputError(f"a window of {window} leaves nothing of {len(left)} samples; shorten it.")
        fit = identify(rest, structure, orders, delay, **options)
        e = (fit.simulate_record(left, window=window) - left.y)[window:]
        squares.append(float(np.nansum(e**2)))
        counts.append(int(np.isfinite(e).sum()))
    mean = sum(squares) / sum(counts)
    each = np.array(squares) / np.array(counts) / (mean or 1.0)
    deviation = of_few(float(np.std(each, ddof=1)) / np.sqrt(len(each)), len(each) - 1)
    return float(np.sqrt(mean)), float(np.sqrt(mean)) * deviation / 2


def _left_out(records: Any, structure: str, orders: Any, nk: int, folds: int, options: dict) -> float:
    """Mean squared one-step error on what was left out, each block predicted by a model of the others."""
    from estimators.pem import identify

    given = as_records(records, missing=bool(options.get("missing")))
    loss, count = 0.0, 0
    for rest, left in _blocks(given, folds):
        at_rest = (
            options.get("initial") or ("estimate" if options.get("offset", True) else "zero")
        ) == "zero"
        opening = "zero" if at_rest and len(given) > 1 else "estimate"
        settings: dict[str, Any] = {**options, "initial": opening}
        fit = identify(rest, structure, orders, nk, **settings)
        e = fit.residuals_of(left, initial=opening)
        loss, count = loss + float((e**2).sum()), count + e.size
    return loss / count
