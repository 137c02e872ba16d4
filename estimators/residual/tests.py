"""Residual tests: what a model has left in its residuals, lag by lag and together.

Under the hypothesis that nothing is missing, e = M e0 with the true noise e0 and M = I - J (J'J)^-1 J' the
projection that the fit of the parameters makes (J the sensitivities). A correlation z = X'e with columns X is
then normal with covariance (M X)' Sigma (M X): that is what is used, with Sigma the noise's own covariance
(coloured noise included) estimated by an autoregression of the residuals. Without the projection the test of a fit's
residuals is wrong both ways: in AR(0.9) noise it rejects 12 % at a level of 5 %, in white noise .5 %."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.residual.algebra import (
    Parts,
    delayed,
    inverse,
    of_size_one,
    powers_of_two,
    spread_of,
    taken_up,
)
from estimators.residual.measures import in_ranges, p_stated
from oed.data import Record, check_sizes, entry_name, frozen
from oed.errors import InputError
from oed.files.objects import as_records

QUESTIONS = {
    "whiteness": " (is what is left noise without memory?)",
    "input": " (is nothing left that the input explains?)",
    "feedback": " (does the input not follow what is left?)",
}


@dataclass(frozen=True, eq=False)
class ResidualTest:
    """Correlations at several lags, each with its p-value, and all together.

    Attributes
    ----------
    name : str
        What was correlated with what.
    lags : ndarray of int
        (L,) in samples; positive where the residual comes later.
    correlation : ndarray
        (L,) correlation coefficients.
    deviation : ndarray
        (L,) their standard deviations if nothing is missing.
    p_values : ndarray
        (L,) two-sided, each lag by itself.
    statistic : float
        z' Cov^+ z over all lags; chi-squared with `freedom` degrees of freedom if nothing is missing.
    freedom : int
        Rank of Cov.
    p_value : float
        Of the statistic.
    """

    name: str
    lags: NDArray[np.int64]
    correlation: NDArray[np.float64]
    deviation: NDArray[np.float64]
    p_values: NDArray[np.float64]
    statistic: float
    freedom: int
    p_value: float

    def significant(self, level: float = 0.01) -> NDArray[np.int64]:
        """Lags at which the correlation is significant after Holm's correction for the number of lags.

        Parameters
        ----------
        level : float
            Probability of naming any lag where nothing is missing.

        Returns
        -------
        ndarray of int
            Lags, ascending.
        """
        order = np.argsort(self.p_values)
        limits = level / np.arange(len(order), 0, -1)
        failed = np.flatnonzero(self.p_values[order] > limits)
        return np.sort(self.lags[order[: failed[0] if failed.size else len(order)]])

    def to_dict(self) -> dict:
        """Plain numbers.

        Returns
        -------
        dict
            All attributes.
        """
        arrays = {x: getattr(self, x).tolist() for x in ("lags", "correlation", "deviation", "p_values")}
        rest = {x: getattr(self, x) for x in ("name", "statistic", "freedom", "p_value")}
        return rest | arrays

    def __repr__(self) -> str:
        lags = in_ranges(self.significant())
        where = f"; significant at lags {lags}" if lags else ""
        asks = QUESTIONS.get(self.name.split("[")[0].split()[0], "")
        return f"{self.name}{asks}: chi2({self.freedom}) = {self.statistic:.4g}, {p_stated(self.p_value, 3)}{where}"


def whiteness(
    fit: Any, records: Record | Sequence[Record], *, lags: int = 25, output: int = 0, fresh: bool = False
) -> ResidualTest:
    """Whether the residual of one output (from 0) is white: its autocorrelations r_1 ... r_L.

    Parameters
    ----------
    fit : Fit
        As in `residual_tests`.
    records : Record or sequence of Record
        The data that were fitted, or fresh data.
    lags : int
        Number of lags.
    output : int
        Which output, from 0.
    fresh : bool
        Whether these data were not used in the fit.

    Returns
    -------
    ResidualTest
        Lags 1 to L.
    """
    return _linear(fit, records, fresh).whiteness(output, lags)


def input_correlation(
    fit: Any, records: Record | Sequence[Record], *, lags: Iterable[int] | int = 25, output: int = 0, input: int = 0,
    fresh: bool = False,
) -> ResidualTest:  # fmt: skip
    """Whether the residual of one output depends on one input: z_l = sum_t e(t) u(t - l), valid for coloured noise.

    Parameters
    ----------
    fit : Fit
        As in `residual_tests`; what it has taken from the residual is accounted for.
    records : Record or sequence of Record
        The data that were fitted, or fresh data.
    lags : iterable of int, or int
        Lags in samples, positive where the residual comes later; a number L means 0 ... L.
    output, input : int
        Which, from 0.
    fresh : bool
        Whether these data were not used in the fit.

    Returns
    -------
    ResidualTest
        One row per lag.
    """
    return _linear(fit, records, fresh).against_input("input", output, input, lags)


def feedback(
    fit: Any, records: Record | Sequence[Record], *, lags: int = 10, output: int = 0, input: int = 0,
    fresh: bool = False,
) -> ResidualTest:  # fmt: skip
    """Whether the input depends on past noise: correlation of the residual with inputs that come after it.

    Parameters
    ----------
    fit : Fit
        As in `residual_tests`.
    records : Record or sequence of Record
        The data that were fitted, or fresh data.
    lags : int
        How many samples ahead.
    output, input : int
        Which, from 0.
    fresh : bool
        Whether these data were not used in the fit.

    Returns
    -------
    ResidualTest
        Lags -L to -1. A small p-value says that there is feedback in the data.
    """
    return _linear(fit, records, fresh).feedback("feedback", output, input, lags)


def residual_tests(
    fit: Any, records: Record | Sequence[Record], *, lags: int = 25, fresh: bool = False
) -> dict[str, ResidualTest]:
    """All residual tests of a fitted model: whiteness, correlation with inputs past and future.

    Parameters
    ----------
    fit : Fit
        Anything with `linearised(record) -> (e (N, ny), J (N, ny, n))`.
    records : Record or sequence of Record
        The data that were fitted, or fresh data.
    lags : int
        Number of lags.
    fresh : bool
        Whether these data were not used in the fit.

    Returns
    -------
    dict of str to ResidualTest
        "whiteness", "input" and "feedback"; with several channels one per output or pair, such as
        "whiteness_2" and "input_21" (output 2, input 1; from 10 channels on "input_2_11").
    """
    of = _linear(fit, records, fresh)
    ny, nu = of.records[0].n_outputs, of.records[0].n_inputs
    tests: dict[str, ResidualTest] = {}
    for i in range(ny):
        row = f"_{i + 1}" if ny > 1 else ""
        tests[f"whiteness{row}"] = of.whiteness(i, lags)
        for k in range(nu):
            entry = f"_{entry_name(i, k, ny, nu)}" if ny * nu > 1 else ""
            tests[f"input{entry}"] = of.against_input(f"input{entry}", i, k, lags)
            tests[f"feedback{entry}"] = of.feedback("feedback", i, k, min(lags, 10))
    return tests


def autocorrelation(
    residuals: NDArray | Parts, *, lags: int = 25, jacobian: Parts | None = None, covariance: NDArray | None = None
) -> ResidualTest:  # fmt: skip
    """Whiteness of (N,) signals whose (N, n) sensitivities to all that was fitted are given; None: nothing
    was fitted. Cov(r) = (I - Gamma' P Gamma / sigma^2) / N with Gamma_l = sum_t J_t e(t - l) and P the (n, n)
    covariance of what was fitted, by default sigma^2 (J'J)^-1: fitted parameters have removed some of the
    correlation (McLeod 1978, JRSS B 40, 296)."""
    parts = _parts(residuals) if jacobian is not None else of_size_one(_parts(residuals))
    lags = _limited(lags, parts)
    total, power = sum(map(len, parts)), sum(float(e @ e) for e in parts)
    if power <= 0:
        return _test("whiteness", np.arange(1, lags + 1), np.zeros(lags), np.eye(lags))
    r = np.array([sum(float(e[k:] @ e[: len(e) - k]) for e in parts) for k in range(1, lags + 1)]) / power
    spread = np.diag([sum(max(len(e) - k, 1) for e in parts) for k in range(1, lags + 1)]) / total**2
    if jacobian is not None:
        stacked = np.concatenate(_parts(jacobian, 2))
        past = np.concatenate([delayed(e[:, None], range(1, lags + 1)) for e in parts])
        gamma = stacked.T @ past / power  # by itself its square may be no double
        if covariance is None:
            covariance = inverse(stacked.T @ stacked) * power / total
        spread = spread - gamma.T @ covariance @ gamma
    return _test("whiteness", np.arange(1, lags + 1), r, spread)


def cross_correlation(
    residuals: NDArray | Parts, inputs: NDArray | Parts, *, lags: Iterable[int] | int = 25
) -> ResidualTest:
    """Correlation of (N,) noise that no fit has touched with (N,) inputs; of a fit's residuals: `input_correlation`."""
    parts = [e[:, None] for e in of_size_one(_parts(residuals))]
    return _against(_Linear((), parts, None, np.eye(1)), "input", 0, _parts(inputs), lags)


@dataclass(frozen=True, eq=False)
class _Linear:
    """Residuals with what the fit has made of them. residuals[r] is (N, ny), sensitivity[r] (N, ny, n) to
    everything that was fitted (None: nothing was), weight (ny, ny) of the least squares, spread (n, n) the
    covariance of what was fitted. known: 1 where that covariance adds to the residuals' (fresh data), -1
    where a posterior's has been taken from it, 0 where the fit is least squares, whose projection is exact.
    influence[r] (N, ny, m) is what noise adds to the first m parameters where these are no least squares
    estimate."""

    records: Sequence[Record]
    residuals: Parts
    sensitivity: Parts | None
    weight: NDArray
    spread: NDArray | None = None
    known: int = 0
    influence: Parts | None = None

    def whiteness(self, i: int, lags: int) -> ResidualTest:
        jacobian = (
            None if self.known == 1 or self.sensitivity is None else [j[:, i] for j in self.sensitivity]
        )
        return autocorrelation(
            [e[:, i] for e in self.residuals], lags=lags, jacobian=jacobian, covariance=self.spread
        )

    def against_input(self, name: str, i: int, k: int, lags: Iterable[int] | int) -> ResidualTest:
        return _against(self, name, i, [r.u[:, k] for r in self.records], lags)

    def feedback(self, name: str, i: int, k: int, lags: int) -> ResidualTest:
        return self.against_input(name, i, k, range(-_limited(lags, self.residuals), 0))


def _linear(fit: Any, records: Record | Sequence[Record], fresh: bool) -> _Linear:
    given = as_records(records)
    for record in given:
        check_sizes(record, "the record")
    linear = [fit.linearised(r) for r in given]
    shared = len(fit.covariance)
    levels = int(bool(np.any(fit.output_level_errors))) * given[0].n_outputs
    common = shared + levels
    own = linear[0][1].shape[2] - common
    wide = []
    for r, (_, j) in enumerate(linear):
        states = np.zeros((*j.shape[:2], own * len(given)))
        states[:, :, r * own : (r + 1) * own] = j[:, :, common:]
        wide.append(np.concatenate([j[:, :, :common], states], axis=2))
    # In units, of outputs and of parameters, in which squares are doubles whatever the user's are.
    high = powers_of_two(np.concatenate([e for e, _ in linear]), (0,))
    broad = powers_of_two(np.concatenate(wide) / high[:, None], (0, 1))
    residuals = [e / high for e, _ in linear]
    wide = [j / high[:, None] / broad for j in wide]
    weight = np.linalg.inv(fit.noise_covariance / high / high[:, None])
    stacked = np.concatenate(wide)
    spread = inverse(np.einsum("tam,ab,tbn->mn", stacked, weight, stacked))
    posterior = not fresh and getattr(fit, "regularisation", None) is not None
    influence = None
    if not fresh and getattr(fit, "subspace", None) is not None:
        influence = [x * high[:, None] * broad[: x.shape[2]] for x in fit.subspace.influence]
        if [len(x) for x in influence] != [len(e) for e in residuals]:
            raise InputError(
                f"records of {[len(e) for e in residuals]} samples, and {[len(x) for x in influence]} were fitted; give "
                "those that were fitted, or fresh=True."
            )
    if fresh or posterior:
        spread = np.zeros_like(spread)
        own = fit.regularisation.posterior if posterior else fit.covariance
        spread[:shared, :shared] = own * broad[:shared] * broad[:shared, None]
    if posterior and levels:
        spread[shared:common, shared:common] = np.diag((fit.output_level_errors * broad[shared:common]) ** 2)
    return _Linear(given, residuals, wide, weight, spread, int(fresh) - int(posterior), influence)


def _against(of: _Linear, name: str, i: int, u: Parts, lags: Iterable[int] | int) -> ResidualTest:
    """The residual of output i against an input, after a fit of all outputs together weighted by W. e_i =
    e0_i - J_i P sum J' W e0 with P = (sum J' W J)^-1, so that z = sum_k Y_k' e0_k with Y_k = (k = i) X - (J
    W)_k P (J_i' X): as many columns as lags for every output k. Of a posterior with covariance P the residual
    has taken up X' J P J' X, the prior's share left in it. Where the first parameters are no minimum of this
    sum but moved by sum_t kappa_t e0(t), the influence, the others alone are fitted, and Y_k gains kappa_k
    (sum_m J_m' Y_m)."""
    parts = of.residuals
    if [len(x) for x in parts] != [len(x) for x in u]:
        raise InputError(
            f"the residuals have {[len(x) for x in parts]} samples and the inputs {[len(x) for x in u]}; "
            "they must be equal, record by record."
        )
    chosen = np.arange(_limited(lags, parts) + 1) if isinstance(lags, int) else np.array([*lags], int)
    u = of_size_one(u)  # of which sums are doubles
    average = sum(x.sum() for x in u) / sum(map(len, u))
    u = of_size_one([x - average for x in u])
    columns = [delayed(x[:, None], chosen) for x in u]
    power = sum(float(e[:, i] @ e[:, i]) for e in parts)
    z = np.sum([x.T @ e[:, i] for x, e in zip(columns, parts, strict=True)], axis=0)
    extra: NDArray | float = 0.0
    per_output = [[x if k == i else np.zeros_like(x) for x in columns] for k in range(parts[0].shape[1])]
    if of.sensitivity is not None and of.known:
        cross = np.sum([j[:, i].T @ x for j, x in zip(of.sensitivity, columns, strict=True)], axis=0)
        extra = of.known * (cross.T @ of.spread @ cross)
    elif of.sensitivity is not None:
        per_output = taken_up(per_output, of.sensitivity, of.weight, of.influence)
    covariance = spread_of(parts, per_output) + extra
    size = np.sqrt(power * sum(float(x @ x) for x in u)) or 1.0
    return _test(name, chosen, z / size, covariance / size**2)


def _test(name: str, lags: NDArray, r: NDArray, covariance: NDArray) -> ResidualTest:
    from scipy.special import chdtrc, erfc

    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    # A lag whose correlation the fit has set to zero tells nothing: its spread is none.
    told = size > 1e-6 * size.max(initial=0.0)
    z = np.where(told, r / np.where(told, size, 1.0), 0.0)
    unit = covariance / np.outer(np.where(told, size, 1.0), np.where(told, size, 1.0))
    values, vectors = np.linalg.eigh(unit[np.ix_(told, told)])
    keep = values > 1e-3
    turned = vectors[:, keep].T @ z[told]
    statistic, freedom = float(np.sum(turned**2 / values[keep])), int(keep.sum())
    return ResidualTest(
        name, frozen(lags, int), frozen(r), frozen(size), frozen(np.where(told, erfc(np.abs(z) / np.sqrt(2)), 1.0)),
        statistic, freedom, float(chdtrc(freedom, statistic)) if freedom else 1.0,
    )  # fmt: skip


def _limited(lags: int, parts: Parts) -> int:
    most = min(map(len, parts)) // 4
    if lags < 1 or most < 1:
        raise InputError(
            f"{lags} lags of records of at least {min(map(len, parts))} samples; ask for 1 or more, and give "
            "4 samples or more per record."
        )
    return min(lags, most)


def _parts(signals: ArrayLike | Parts, axes: int = 1) -> list[NDArray[np.float64]]:
    """A list of arrays, (N,) or (N, n), from one or several."""
    given = list(signals) if isinstance(signals, list | tuple) else [signals]  # type: ignore[list-item]
    arrays = [np.asarray(x, dtype=float) for x in given]
    arrays = [x[:, 0] if axes == 1 and x.ndim == 2 and x.shape[1] == 1 else x for x in arrays]
    if not arrays or any(x.ndim != axes or not len(x) for x in arrays):
        raise InputError(
            f"residuals and inputs are tested one channel at a time, as {'(N,)' if axes == 1 else '(N, n)'} arrays; "
            f"shapes given: {[x.shape for x in arrays]}."
        )
    return arrays
