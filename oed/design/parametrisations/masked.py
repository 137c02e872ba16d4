"""Designs under frequency-wise limits: the density of the input or the output may not exceed a mask, nor the power a limit.

For every X and nu >= 0 no admissible spectrum has more of tr(X'(M - M_0)X) than

    h(nu) = nu + (1/pi) int_0^pi  max over the densities Phi within the masks of tr[(S - nu I / P) Phi] dw,   S = D^* X X' D,

(weak duality; P the power limit), so loss >= numerator(X) / (tr X' M_0 X + h). The maximising density is known frequency
by frequency (`oed.design.problem.masks`): all of the mask where S is above nu, nothing where it is below. Such densities
are the columns of the design problem, each one found by the certificate of those before it, and their information is an
integral over panels that are cut where a density jumps. So loss and bound are those of densities on the whole band.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import on_one_thread, real_gram, square_root
from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.assembling import assembled, told_apart
from oed.design.parametrisations.densities import Density, Panels, Pricing
from oed.design.parametrisations.masked_polishing import polished_density
from oed.design.problem.budgets import power_budgets
from oed.design.problem.certificate import Certificate
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.design import Design
from oed.design.problem.information_maps import information_map
from oed.design.problem.lines import Columns, Problem
from oed.design.problem.masks import Mask, Masks, hermitian_root
from oed.design.solvers.column_generation import solve_weights
from oed.errors import InfeasibleDesign
from oed.theory.quadrature import integral

NARROWEST = 1e-3
"""The ceiling on a density lets all the power into this share of the narrowest resonance: to 1e-6 that is a line."""
WIDEST = 0.3
"""What counts as the width of a plant without resonances, rad/sample."""
MOST_ROUNDS = 60
"""Densities tried; smooth problems take about ten."""
STEPS = 40
"""Quasi-Newton steps on the certificate in a round."""
PIECES = 12
"""Parts of the band in which the densities are mixed on their own: more of them, fewer rounds, each dearer."""
PATIENCE = 8
"""Rounds without a smaller gap after which rounding holds it up."""
RESOLVED = 1e-9
"""Accuracy of the integrals, relative: what the certificate's bound is lowered by; a tenth of the tolerance where that is less."""
NEARLY = 1e-3
"""Gap below which the jumps of the density show well enough to try Newton's method on them."""
FLAT = 2e-3
"""Relative gain of the bound in a quasi-Newton step, in units of the tolerance, below which it is the last."""
AGAIN = 0.3
"""Share of the gap of the last trial at which the next is worth its time."""


@on_one_thread
def masked_design(
    model: Any,
    criterion: str | Criterion = "D",
    *,
    input_mask: Mask | None = None,
    output_mask: Mask | None = None,
    input_power: float = 1.0,
    tolerance: float = 1e-6,
) -> Design:
    """The optimal spectrum whose density stays below a mask.

    Parameters
    ----------
    model : Plant, Model or InformationMap
        Any number of inputs.
    criterion : str or Criterion
        As for `solve_design`.
    input_mask, output_mask : callable, optional
        omega (K,) -> largest two-sided density of the input, of the noise-free output; (1/2pi) times its
        integral over the circle is a power. (K,) for one channel, else (K, nu, nu) and (K, ny, ny) Hermitian matrices.
        Where a mask jumps or is infinite, it may.
    input_power : float
        Limit on the input power, summed over channels.
    tolerance : float
        Relative gap to reach.

    Returns
    -------
    Design
        Its lines are the nodes of a quadrature of the density, and its certificate holds for every density within the
        masks (and below a ceiling at which all the power lies within a thousandth of the narrowest resonance).

    Raises
    ------
    InputError
        If a mask is negative, not Hermitian, not positive semidefinite or of the wrong shape.
    InfeasibleDesign
        If the masks leave no power at any frequency.
    """
    information = information_map(model)
    wanted = criterion_of(criterion, model, information)
    limit = power_budgets(information, input_power)[0].limit
    narrow = min(WIDEST, float(information.resonances[:, 1].min(initial=WIDEST)))
    masks = Masks(information, input_mask, output_mask, limit * np.pi / (NARROWEST * narrow))
    panels = Panels.of(masks, min(RESOLVED, 0.1 * tolerance))
    _check_open(panels, masks)
    used = np.einsum("kij,kij->k", panels.R, panels.R.conj()).real > 0
    problem = Problem(information, wanted, power_budgets(information, input_power), panels.omega[used])
    problem, in_own_parameters = told_apart(problem, criterion)
    return in_own_parameters(_Search(problem, masks, limit, tolerance).run(panels))


class _Search:
    """Column generation over densities."""

    def __init__(self, problem: Problem, masks: Masks, limit: float, tolerance: float) -> None:
        self.problem, self.masks, self.limit, self.tolerance = problem, masks, limit, tolerance
        self.ends, self.accuracy = np.zeros(0), min(RESOLVED, 0.1 * tolerance)
        self.pricing = Pricing(problem, masks, limit)

    def run(self, panels: Panels) -> Design:
        # The first: everything, whatever its power; the second: what white noise would find worth most.
        n = self.problem.map.n
        self.ends = panels.edges[np.linspace(0, len(panels.edges) - 1, PIECES + 1).astype(int)][1:-1]
        best = self._best(panels, self.problem.criterion.direction(np.eye(n)))
        found, pieces, start = [Density(np.eye(n), 0.0), best], np.ones((2, PIECES), dtype=bool), None
        panels = self.pricing.cut(panels, best)
        bound, kept, loss, stalled, near = self._bound(panels, best), None, np.inf, 0, NEARLY
        # Of an eigenvalue Newton's method takes many steps until the multiplicity shows, and mixing few rounds.
        smooth = self.problem.criterion.method == "smooth"
        for _ in range(MOST_ROUNDS):
            gap = max(loss / bound - 1, self.tolerance)
            columns, phi = self._columns(panels, found, pieces)
            weights = solve_weights(self.problem, columns, start, max(1e-12, min(1e-4, 1e-2 * gap)))
            w = weights.w / max(1.0, float((columns.q.T @ weights.w).max()))
            value = self.problem.criterion.loss(self.problem.constant + columns.information(w))
            W = np.zeros(pieces.shape)
            W[pieces] = w
            if kept is None or value < loss:
                shares = W[:, self._piece(panels)]
                loss, kept = value, (panels, np.einsum("mk,mkij->kij", shares, phi, optimize=True))
            new = []
            # A density within both masks is dear: there the price is the one that the weights found.
            priced = Density(weights.X, float(weights.nu[0]))
            for density in (priced if panels.B is not None else self._best(panels, weights.X), None):
                new.append(density or self._climbed(panels, best))
                panels = self.pricing.cut(panels, new[-1])
                proof = self._bound(panels, new[-1])
                if proof > bound:
                    bound, best = proof, new[-1]
            polished = None
            if self.tolerance < loss / bound - 1 < near and (smooth or stalled):
                near = AGAIN * (loss / bound - 1)
                polished = polished_density(self.pricing, panels, best, self.accuracy)
            if polished is not None:
                panels, one, own = polished
                proof, value = (
                    self._bound(panels, one),
                    self.problem.criterion.loss(self.pricing.told(panels, own)),
                )
                if value < loss:
                    loss, kept = value, (panels, own)
                if proof > bound:
                    bound, best = proof, one
            stalled = stalled + 1 if loss / bound - 1 > 0.9 * gap else 0
            if loss / bound - 1 <= self.tolerance or stalled == PATIENCE:
                break
            stay = w > 1e-9 * w.max()
            pieces[pieces] = stay
            used = np.count_nonzero(pieces, axis=1) > 0
            found = [one for one, s in zip(found, used, strict=True) if s] + new
            pieces = np.concatenate([pieces[used], np.ones((len(new), PIECES), dtype=bool)])
            start = np.append(w[stay], np.full(len(new) * PIECES, 0.1 / (1 + stay.sum())))
        nodes, phi = kept if kept is not None else (panels, np.zeros(panels.R.shape))
        return self._design(nodes, phi, best, self._bound(panels, best, exactly=True))

    def _piece(self, panels: Panels) -> NDArray[np.int64]:
        """Which piece of the band every node belongs to."""
        return np.searchsorted(self.ends, panels.omega)

    def _columns(
        self, panels: Panels, found: list[Density], pieces: NDArray[np.bool_]
    ) -> tuple[Columns, NDArray[np.complex128]]:
        """Information of the pieces of the densities, their shares of the power and of their piece; the densities."""
        D, piece = self.pricing.factor(panels), self._piece(panels)
        phi = np.stack([self.pricing.at(panels, one)[0] for one in found])
        F, shares = [], []
        for one, wanted in zip(phi, pieces, strict=True):
            told = D @ (hermitian_root(one) * np.sqrt(panels.weight)[:, None, None])[:, None]
            power = np.einsum("kii,k->k", one, panels.weight).real
            for p in np.flatnonzero(wanted):
                own = piece == p
                flat = np.moveaxis(told[own], 1, 0).reshape(D.shape[1], -1)
                F.append(square_root(real_gram(flat)))
                shares.append(np.append(power[own].sum() / self.limit, np.arange(PIECES) == p))
        direction = np.full((len(F), D.shape[3]), 1 / np.sqrt(D.shape[3]), dtype=complex)
        return Columns(np.zeros(len(F)), direction, np.stack(F), np.stack(shares)), phi

    def _best(self, panels: Panels, X: NDArray) -> Density:
        """With the price of power at which the bound is best; it is convex in the price."""
        from scipy.optimize import minimize_scalar

        free = Density(X, 0.0)
        S = free.worth(self.pricing.factor(panels), self.limit)
        top = self.limit * float(np.linalg.eigvalsh(S)[:, -1].max())
        eye = np.eye(S.shape[1]) / self.limit
        h = lambda nu: nu + float(panels.weight @ self.masks.most(panels.R, panels.B, S - nu * eye)[1])
        if not np.isfinite(top) or top <= 0:
            return free
        found = minimize_scalar(h, bounds=(0.0, top), method="bounded", options={"xatol": 1e-13 * top})
        return replace(free, nu=min((h(x), x) for x in (0.0, float(found.x)))[1])

    def _climbed(self, panels: Panels, one: Density) -> Density:
        """A certificate of a larger bound, by quasi-Newton steps: its gradient is the information of its own density."""
        from scipy.optimize import minimize

        problem, D = self.problem, self.pricing.factor(panels)
        (K, _, r, q), flat = D.shape, np.moveaxis(D, 1, 0).reshape(D.shape[1], -1)
        criterion, shape = problem.criterion, one.X.shape
        unit, price = np.abs(one.X).max(), max(one.nu, 1e-12)

        def against(x: NDArray) -> tuple[float, NDArray[np.float64]]:
            X, nu = unit * x[:-1].reshape(shape), price * x[-1]
            E = (X.T @ flat).reshape(-1, K, r, q).swapaxes(0, 1).reshape(K, -1, q)
            T = E.conj().swapaxes(1, 2) @ E - nu / self.limit * np.eye(q)
            phi, worth = self.masks.most(panels.R, panels.B, T)
            half = ((E @ phi).conj() * panels.weight[:, None, None]).reshape(K, -1, r, q)
            slope = (flat @ half.transpose(0, 2, 3, 1).reshape(K * r * q, -1)).real
            used = float(np.einsum("kii,k->", phi, panels.weight).real) / self.limit
            most = float(np.sum(X * (problem.constant @ X))) + nu + float(panels.weight @ worth)
            steep, _ = criterion.log_numerator(X, False)
            numerator = float(np.log(max(criterion.numerator(X), 1e-300)))
            down = (2 * problem.constant @ X + 2 * slope) / most - steep
            return np.log(most) - numerator, np.append(unit * down.ravel(), price * (1 - used) / most)

        x = np.append(one.X.ravel() / unit, one.nu / price)
        bounds = [(None, None)] * one.X.size + [(0.0, None)]
        found = minimize(
            against,
            x,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds,
            options={
                "maxiter": STEPS,
                "maxcor": 30,
                "ftol": max(1e-15, FLAT * self.tolerance),
                "gtol": 10 * self.tolerance,
            },
        ).x
        return Density(unit * found[:-1].reshape(shape), price * found[-1])

    def _bound(self, panels: Panels, one: Density, exactly: bool = False) -> float:
        """Scaled bound of a certificate; exactly: by an integral that closes in on the kinks, lowered by its accuracy."""
        if exactly and panels.B is None:
            worth = lambda w: self.masks.most(
                *self.masks.at(w), one.worth(self.problem.scaled_factor(w), self.limit)
            )[1]
            most = float(integral(worth, panels.edges, self.accuracy)) / np.pi * (1 + self.accuracy)
        else:
            most = float(panels.weight @ self.pricing.at(panels, one)[1])
        fixed = float(np.sum(one.X * (self.problem.constant @ one.X)))
        return self.problem.criterion.numerator(one.X) / (fixed + one.nu + most)

    def _design(self, panels: Panels, phi: NDArray, one: Density, bound: float) -> Design:
        problem = self.problem
        power = phi * panels.weight[:, None, None]
        share = np.einsum("kii->k", power).real
        keep = share > 0
        spectrum = Spectrum(panels.omega[keep], power[keep])
        sizes, directions = np.linalg.eigh(spectrum.power)
        q = sizes.shape[1]
        lines = problem.columns(np.repeat(spectrum.omega, q), directions.swapaxes(1, 2).reshape(-1, q))
        # From the factor, in the coordinates of the problem: the information itself may have no digits of it.
        loss = problem.loss(lines, np.maximum(sizes.ravel(), 0.0)) * problem.scale
        bound = bound * problem.scale
        X = np.asarray(np.linalg.solve(problem.R, one.X), dtype=np.float64)
        numerator = problem.original.numerator(X)
        unit = np.array([max(one.nu, 1e-300)])
        prices = problem.prices_at(spectrum.omega, one.X, unit).ratio
        certificate = Certificate(
            X=X, multipliers={"input power": one.nu}, numerator=numerator, value=numerator / bound, bound=bound,
            largest_price=float(prices.max()), frequency=float(spectrum.omega[np.argmax(prices)]),
            price=lambda omega: problem.prices_at(omega, one.X, unit).ratio,
            rounding=problem.rounding(lines, np.maximum(sizes.ravel(), 0.0)),
        )  # fmt: skip
        return assembled(
            problem, spectrum, certificate, loss, used={"input power": spectrum.total_power},
            tolerance=self.tolerance, solver="newton", rounds=1,
        )  # fmt: skip


def _check_open(panels: Panels, masks: Masks) -> None:
    """An InfeasibleDesign where the masks leave no power."""
    if np.any(panels.R):
        return
    from_input = (
        None
        if masks.on_input is None
        else np.any(replace(masks, on_output=None).at(panels.omega)[0], axis=(1, 2))
    )
    if from_input is not None and masks.on_output is not None and from_input.any():
        at = panels.omega[from_input]
        raise InfeasibleDesign(
            f"the input mask clashes with the output mask: the input may have power between {at[0]:.4g} and "
            f"{at[-1]:.4g} rad/sample only, and there the output mask is 0; raise one where the other is open."
        )
    which = "input" if from_input is not None and not from_input.any() else "output"
    raise InfeasibleDesign(
        f"the {which} mask is 0 at every frequency, so no input satisfies it; raise it somewhere."
    )
