"""Records made ready for a structure: deviations, scaled channels, delayed inputs, and the loss over all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.pem.predictors.kernel import Kernel, Sums
from estimators.pem.predictors.of_structure import (
    Structure,
    kernel_for,
    parameter_scale,
    predictor_is_stable,
    projected,
    samples,
    walls,
)
from estimators.pem.search.levenberg_marquardt import Optimum, Point, determined, minimise
from oed.data import Record
from oed.models.model import StateSpace

TOLD = 1e-8
"""Least eigenvalue of the initial states' products, over the largest, that is taken off the information of the parameters: below, it
has less than half its digits, and what it takes off is rounding. Paths from several inputs with poles alike have such states."""

APART = 1e-12
"""From singular information a search keeps this far, as a share: what rounding leaves of it where initial states are eliminated too."""


Evaluation = Callable[[NDArray, Any], Point | None]
"""(z, initial states) -> the loss there; None where it is not finite."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The prediction-error loss of one structure on several records, in scaled units. `structure` the
    structure; `kernel` its predictor; `data` (N, nd) samples of all records, one after the other; `lengths`
    (R,) samples of each record; `scale` (n + levels,) factor from scaled parameters to the user's units;
    `input_level, output_level, input_scale, output_scale` what was taken off each channel, and divided by;
    `n_initial` unknown initial states per record; `weight` (ny, ny) inverse of the assumed residual
    covariance, in scaled units; `variant` "", "weighted" or "missing": which kernel; `n_observed` rows with
    an observed output; `n_values` observed outputs, counted one by one; `noise` (ny, ny) covariance of the
    innovations up to a factor, in scaled units: of state-space models of several outputs with missing
    samples, whose residuals are whitened by it; `lower, upper` bounds of the scaled parameters; equal where a
    parameter is known; `prior_mean, prior_precision` (z - mean)' precision (z - mean) is added to the loss."""

    structure: Structure
    kernel: Kernel
    data: NDArray[np.float64]
    lengths: NDArray[np.int64]
    scale: NDArray[np.float64]
    input_level: NDArray[np.float64]
    output_level: NDArray[np.float64]
    input_scale: NDArray[np.float64]
    output_scale: NDArray[np.float64]
    n_initial: int
    weight: NDArray[np.float64]
    variant: str = ""
    n_observed: int = 0
    n_values: int = 0
    noise: NDArray[np.float64] | None = None
    lower: NDArray[np.float64] | None = None
    upper: NDArray[np.float64] | None = None
    prior_mean: NDArray[np.float64] | None = None
    prior_precision: NDArray[np.float64] | None = None

    @property
    def n_samples(self) -> int:
        """Samples of all records together."""
        return len(self.data)

    @property
    def n_parameters(self) -> int:
        """Number of parameters and levels."""
        return len(self.scale)

    def projected(self, z: NDArray, mirror: bool = True) -> NDArray:
        """Parameters nearby whose predictor is stable, where there is a simple way to them."""
        z = projected(self.structure, z, mirror)
        return z if self.lower is None else np.clip(z, self.lower, self.upper)

    def points(self, zs: Iterable[NDArray]) -> list[Point]:
        """The loss at each of some parameters, or nearby, where it is finite."""
        return [p for z in zs if (p := self.evaluate(self.projected(z))) is not None]

    def descend(
        self, point: Point, *, max_iterations: int, tolerance: float, free: NDArray | None = None,
        enough: Callable[[Point, float], bool] | None = None, evaluate: Evaluation | None = None,
    ) -> Optimum:  # fmt: skip
        """Minimise from a point, within the bounds, this problem's loss or another one of its parameters: free (n,)."""
        bounds = None
        if self.lower is not None and self.upper is not None:
            bounds = self.lower, self.upper
        return minimise(
            evaluate or self.evaluate, point, project=self.projected, clip=lambda z: self.projected(z, mirror=False),
            walls=lambda z: walls(self.structure, z), max_iterations=max_iterations,
            tolerance=tolerance, free=free, bounds=bounds, enough=enough,
        )  # fmt: skip

    def with_weights(self, weights: NDArray) -> Problem:
        """The same problem with a weight for every sample: weights (N, ny)."""
        known = self.data if self.variant == "" else self.data[:, : -self.structure.n_outputs]
        levels = self.n_parameters > self.structure.n
        return self.replace(
            kernel=kernel_for(self.structure, levels, self.n_initial > 0, "weighted"),
            data=np.ascontiguousarray(np.column_stack([known, np.sqrt(weights)])),
            variant="weighted",
        )

    def with_noise(self, noise: NDArray) -> Problem:
        """The same problem with another covariance of the innovations: noise (ny, ny)."""
        lower = noise[np.tril_indices(len(noise))]
        known = self.data if self.noise is None else self.data[:, : -len(lower)]
        data = np.column_stack([known, np.broadcast_to(lower, (len(known), len(lower)))])
        return self.replace(data=np.ascontiguousarray(data), noise=noise)

    def evaluate(self, z: NDArray, initial: Any = None, *, affine: bool = False) -> Point | None:
        """Loss, gradient and Gauss-Newton matrix with the initial states eliminated: initial (R, m). `affine` where only
        parameters will move in which, together with the states, the residual is affine: the states then start anywhere."""
        if not predictor_is_stable(self.structure, z[: self.structure.n]):
            return None
        m, n = self.n_initial, self.n_parameters
        if m and affine and self.variant != "missing":
            initial = np.zeros((len(self.lengths), m))
        elif m and initial is None:
            initial = self._settled(z)
            if initial is None:
                return None
        sums = self._sums(z, initial)
        gradient, hessian = sums.gradient.sum(axis=0), sums.hessian.sum(axis=0)
        follow: Any = lambda d: None
        loss = float(sums.loss.sum())
        if m:
            inverse, told = _inverses(sums.hessian[:, n:, n:])
            pull = np.einsum("rij,rj->ri", inverse, sums.gradient[:, n:])
            loss -= float(np.vdot(pull, sums.gradient[:, n:])) if affine else 0.0
            cross = inverse @ sums.hessian[:, n:, :n]
            back = np.swapaxes(sums.hessian[:, n:, :n], 1, 2)
            taken = cross if told is inverse else told @ sums.hessian[:, n:, :n]
            gradient = gradient[:n] - np.einsum("rij,rj->i", back, pull)
            hessian = hessian[:n, :n] - (back @ taken).sum(axis=0)
            states = initial
            follow = lambda d: states - pull - cross @ d
        if sums.log_variance is not None:
            total = sums.log_variance.sum(axis=0)
            slope, growth = total[1 : 1 + n] / (2 * self.n_values), np.exp(total[0] / self.n_values)
            cross_term = np.outer(gradient, slope)
            hessian = growth * (hessian + cross_term + cross_term.T + loss * np.outer(slope, slope))
            gradient, loss = growth * (gradient + loss * slope), growth * loss
        if self.prior_precision is not None:
            away = z - self.prior_mean
            pull_back = self.prior_precision @ away
            loss, gradient = loss + float(away @ pull_back), gradient + pull_back
            hessian = hessian + self.prior_precision
        if not (np.isfinite(loss) and np.isfinite(hessian).all()):
            return None
        covariance = sums.covariance.sum(axis=0) / self.n_observed
        if self.noise is not None:
            covariance = self.noise * float(sums.loss.sum()) / self.n_values
        return Point(z, loss, gradient, hessian, follow, (initial, covariance))

    def _sums(self, z: NDArray, initial: NDArray | None) -> Sums:
        parameters = np.broadcast_to(z, (len(self.lengths), len(z)))
        if initial is not None:
            parameters = np.hstack([parameters, initial])
        return self.kernel.sums(self.data, self.lengths, parameters, self.weight)

    def _settled(self, z: NDArray) -> NDArray | None:
        """Best initial states at given parameters: the residual is affine in them."""
        n = self.n_parameters
        sums = self._sums(z, np.zeros((len(self.lengths), self.n_initial)))
        if not np.isfinite(sums.hessian).all():
            return None
        inverse, _ = _inverses(sums.hessian[:, n:, n:])
        return -np.einsum("rij,rj->ri", inverse, sums.gradient[:, n:])

    def records(self) -> list[NDArray[np.float64]]:
        """The samples record by record: returns (N, nd)."""
        ends = np.cumsum(self.lengths).tolist()
        return [self.data[a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]

    def first(self, samples: int) -> Problem:
        """The same problem on the first samples alone, records that begin later left out."""
        lengths, left = [], samples
        for length in self.lengths:
            if left > 0:
                lengths.append(min(int(length), left))
                left -= lengths[-1]
        rows = sum(lengths)
        return self.replace(data=self.data[:rows], lengths=np.array(lengths), n_observed=rows)

    def residuals(self, point: Point) -> list[NDArray[np.float64]]:
        """One-step prediction errors in the user's units: returns (N, ny)."""
        initial = point.extra[0]
        initial = np.zeros((len(self.lengths), 0)) if initial is None else initial
        found = [
            self.kernel.trace(data, np.concatenate([point.z, x]), False)[0]
            for data, x in zip(self.records(), initial, strict=True)
        ]
        if self.noise is not None:
            found = [self._coloured(e, data) for e, data in zip(found, self.records(), strict=True)]
        return [e * self.output_scale for e in found]

    def _coloured(self, white: NDArray, data: NDArray) -> NDArray[np.float64]:
        """Whitened residuals as prediction errors again, each set of observed outputs with its own covariance."""
        ny, noise = self.structure.n_outputs, np.asarray(self.noise)
        at = data.shape[1] - ny * (ny + 1) // 2 - ny
        seen, e = data[:, at : at + ny] > 0, np.array(white)
        for pattern in np.unique(seen, axis=0):
            rows = np.all(seen == pattern, axis=1)
            masked = np.where(np.outer(pattern, pattern), noise, np.eye(ny))
            e[rows] = white[rows] @ np.linalg.cholesky(masked).T
        return e

    def replace(self, **changes: Any) -> Problem:
        """The same problem with some attributes changed."""
        return Problem(**({name: getattr(self, name) for name in self.__dataclass_fields__} | changes))

    def moment(self, z: NDArray, initial: NDArray | None) -> NDArray[np.float64] | None:
        """Second moment of the residuals in scaled units; None where the predictor is unstable: initial (R, m) -> (ny, ny)."""
        if not predictor_is_stable(self.structure, z[: self.structure.n]):
            return None
        states = np.zeros((len(self.lengths), 0)) if initial is None else initial
        found = np.concatenate([
            self.kernel.trace(data, np.concatenate([z, x]), False)[0] for data, x in zip(self.records(), states, strict=True)
        ])  # fmt: skip
        moment = found.T @ found / self.n_observed
        return moment if np.isfinite(moment).all() else None


def determining(evaluate: Evaluation, point: Point) -> Evaluation:
    """The same loss where something determines every parameter, so that a step to where nothing does is none; as it is, where nothing
    determines them at the point already."""
    if not determined(point.hessian, APART):
        return evaluate

    def where_determined(z: NDArray, extra: Any) -> Point | None:
        there = evaluate(z, extra)
        return there if there is not None and determined(there.hessian, APART) else None

    return where_determined


def _inverses(hessian: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pseudoinverse of symmetric matrices (R, m, m) in units in which their diagonals are 1, and that of what is told of them;
    numpy's takes thrice as long for small ones."""
    size = 1 / np.sqrt(np.maximum(hessian.diagonal(axis1=1, axis2=2), np.finfo(float).tiny))
    over = size[:, :, None] * size[:, None, :]
    values, vectors = np.linalg.eigh(hessian * over)
    share = np.abs(values)
    share /= share.max(axis=1, keepdims=True)

    def inverse(kept: NDArray) -> NDArray[np.float64]:
        return (
            (vectors * np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)[:, None, :]) @ vectors.mT * over
        )

    whole = inverse(share > 1e-12)
    return whole, whole if share.min() > TOLD else inverse(share > TOLD)


def prepare(
    structure: Structure, records: Sequence[Record], *, offset: bool = False, initial: bool = False,
    scales: tuple[NDArray, NDArray] | None = None, missing: bool = False,
) -> Problem:  # fmt: skip
    """Make records ready for a structure."""
    average = np.nanmean if missing else np.mean
    mean = lambda signals: average(np.concatenate(signals), axis=0)
    u_level = mean([r.u for r in records]) if offset else np.zeros(structure.n_inputs)
    y_level = mean([r.y for r in records]) if offset else np.zeros(structure.n_outputs)
    if scales is None:
        rms = lambda signals, level: np.sqrt(mean([(s - level) ** 2 for s in signals]))
        su, sy = rms([r.u for r in records], u_level), rms([r.y for r in records], y_level)
        scales = np.where(su > 0, su, 1.0), np.where(sy > 0, sy, 1.0)
    su, sy = scales
    data = [samples(structure, (r.u - u_level) / su, (r.y - y_level) / sy) for r in records]
    scale = parameter_scale(structure, su, sy)
    if offset:
        scale = np.concatenate([scale, sy])
    variant = "missing" if missing else ""
    kernel = kernel_for(structure, offset, initial, variant)
    observed = int(sum(np.isfinite(r.y).any(axis=1).sum() for r in records))
    if missing:
        seen = [np.isfinite(r.y).astype(float) for r in records]
        data = [np.column_stack([np.nan_to_num(d), s]) for d, s in zip(data, seen, strict=True)]
    problem = Problem(
        structure, kernel, np.ascontiguousarray(np.concatenate(data)), np.array([len(d) for d in data]), scale,
        u_level, y_level, su, sy, kernel.n - len(scale), np.eye(structure.n_outputs), variant, observed,
        int(sum(np.isfinite(r.y).sum() for r in records)),
    )  # fmt: skip
    several = missing and isinstance(structure, StateSpace) and structure.n_outputs > 1
    return problem.with_noise(np.eye(structure.n_outputs)) if several else problem
