"""G over a band: exchange on the response's variance, the other way round from the exchange of lines.

    minimise over the spectra   max over w in a band of trace(V(w)' M^-1 V(w))

A finite sample of the band gives a loss that is too small and a bound that holds: its certificate is a measure on the
sample. So the sample is exchanged until the maximum over the whole band, found between its lines, meets that bound.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from oed.criteria import d_criterion
from oed.design.problem.design import Design
from oed.design.problem.families import Family
from oed.design.problem.lines import Columns, Problem
from oed.design.solvers.column_generation import Exchange, exchange
from oed.design.solvers.merging_lines import collapsed
from oed.errors import SolverFailure

MOST_ROUNDS = 40
"""Exchanges of the sample; the gap falls by an order in two or three of them."""
SPENT = 1e-6
"""Share of the certificate below which a line of the sample leaves it."""
CLOSE = 0.9
"""Local maxima below this share of the largest variance are not worth a line."""
PATIENCE = 2
"""Rounds without a smaller gap after which rounding, not the sample, is what holds it up."""
EARLY = 0.05
"""A round is solved to this share of the gap that the round before left."""


def worst_response_design(problem: Problem, family: Family, *, refine: bool, tolerance: float) -> Design:
    """The design for the largest variance over a family; `problem` holds the first sample."""
    from oed.design.assembling import certified

    problem, columns = _started(problem, family, refine)
    asked, gap, stalled = 1e-2, np.inf, 0
    least, kept, proof = np.inf, (columns, np.ones(len(columns))), None
    for _ in range(MOST_ROUNDS):
        found = exchange(problem, columns=columns, refine=refine, tolerance=asked)
        found = collapsed(found, asked) if refine else found
        proof = proof or found
        omega, variance = family.maxima(_root(found))
        if variance.max() < least:
            least, kept = float(variance.max()), (found.columns, found.w)
        bound = found.bound * problem.scale
        if bound > proof.bound * proof.problem.scale:
            proof = found
        before, gap = gap, least / (proof.bound * proof.problem.scale) - 1
        stalled = stalled + 1 if gap > 0.9 * before else 0
        if gap <= tolerance or stalled == PATIENCE:
            break
        asked = max(0.5 * tolerance, min(asked, EARLY * gap))
        sample, new = problem.original.V, family.at(omega[variance > CLOSE * variance.max()])
        parts = np.linalg.norm(found.X.reshape(len(found.X), len(sample), -1), axis=(0, 2))
        sample = np.concatenate([sample[parts**2 > SPENT * np.max(parts) ** 2], new])
        problem = found.problem.for_criterion(replace(problem.original, V=sample))
        columns = found.columns.take(found.w > SPENT * found.w.max())
    if proof is None:  # not reached: every round finds weights and a bound
        raise SolverFailure("the exchange of the response's lines did not begin.")
    found = replace(proof, columns=kept[0], w=kept[1], loss=least / proof.problem.scale)
    return certified(found, tolerance=tolerance, solver="newton")


def _started(problem: Problem, family: Family, refine: bool) -> tuple[Problem, Columns]:
    """Lines and sample of the D design, which is the G design where nothing but the power is limited (Kiefer, Wolfowitz)."""
    wanted = problem.original
    found = exchange(problem.for_criterion(d_criterion(wanted.n)), refine=refine, tolerance=1e-6)
    found = collapsed(found, 1e-6) if refine else found
    used = found.w > SPENT * found.w.max()
    omega = np.unique(found.columns.omega[used])
    inside = omega[(omega >= family.grid[0]) & (omega <= family.grid[-1])]
    sample = family.at(np.union1d(inside, family.maxima(_root(found))[0]))
    columns = sample.swapaxes(0, 1).reshape(wanted.n, -1)
    scale = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    if np.linalg.matrix_rank(columns / scale[:, None], 1e-6) < wanted.n:
        sample = np.concatenate([sample, wanted.V])
    return found.problem.for_criterion(replace(wanted, V=sample)), found.columns.take(used)


def _root(found: Exchange) -> NDArray[np.float64]:
    """A root of the covariance in the model's own parameters, from the scaled information, which is well conditioned."""
    problem = found.problem
    half = np.linalg.cholesky(problem.constant + found.columns.information(found.w))
    return np.asarray(np.linalg.inv(problem.R.T @ half), dtype=np.float64)
