"""One input for most of several plants: the least quantile of the losses, by branch and bound on minimax designs.

Of J plants the worst J - k may be given up. The value is the least, over all subsets of k plants, of the subset's
minimax loss; it is not convex, but minimax designs of smaller subsets bound those of larger ones from below:

    include plant j or give it up; a node's bound is the certified minimax bound of the plants it includes.

The search ends with the optimum, or at its limit of designs with the least bound of the nodes that are open."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import on_one_thread
from oed.criteria import Criterion
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.design import Design
from oed.design.problem.information_maps import information_map
from oed.design.questions.robust import robust_design
from oed.errors import InputError, Status


@dataclass(frozen=True, eq=False)
class QuantileDesign:
    """The input of least quantile.

    Attributes
    ----------
    design : Design
        The minimax design of the plants that are kept; its certificate is for them.
    losses : ndarray
        (J,) loss of every plant under its input.
    value : float
        The k-th smallest of the losses.
    bound : float
        No input has a smaller k-th smallest loss.
    kept : tuple of int
        The k plants with the smallest losses.
    solved : int
        Minimax designs that were computed.
    status : Status
        OK where the gap is within the tolerance.
    """

    design: Design
    losses: NDArray[np.float64]
    value: float
    bound: float
    kept: tuple[int, ...]
    solved: int
    status: Status

    @property
    def gap(self) -> float:
        """(value - bound) / bound."""
        return (self.value - self.bound) / self.bound

    def __repr__(self) -> str:
        return (
            f"QuantileDesign: {len(self.kept)} of {len(self.losses)} plants have a loss of at most {self.value:.9g} "
            f"(gap {self.gap:.1e}, {self.solved} designs, {self.status.name})"
        )


@on_one_thread
def quantile_design(
    models: Sequence[Any],
    criterion: str | Criterion = "A",
    *,
    quantile: float = 0.9,
    max_designs: int = 200,
    tolerance: float = 1e-5,
    **options: Any,
) -> QuantileDesign:
    """The input whose loss is small for a given share of the plants.

    Parameters
    ----------
    models : sequence
        The plants that are possible, all equally.
    criterion : str or Criterion
        D, A, E or a c-type name (those with minimax designs).
    quantile : float
        Share of the plants that counts, in (0, 1]; k = ceil(quantile J). With 1 it is the minimax design.
    max_designs : int
        Limit of minimax designs.
    tolerance : float
        Relative gap to reach.
    **options : object
        As for `solve_design`.

    Returns
    -------
    QuantileDesign
        With its certified bound.

    Raises
    ------
    InputError
        If the quantile leaves (0, 1], or there are no plants.
    """
    J = len(models)
    if not J:
        raise InputError("a quantile design needs at least one plant; none was given.")
    if not 0 < quantile <= 1:
        raise InputError(f"the quantile is {quantile}; it must lie in (0, 1].")
    k = int(np.ceil(quantile * J - 1e-9))
    maps = [information_map(model) for model in models]
    criteria = [criterion_of(criterion, model, own) for model, own in zip(models, maps, strict=True)]

    def minimax(chosen: frozenset[int]) -> Design:
        return robust_design(
            [models[j] for j in sorted(chosen)], criterion, how="minimax", tolerance=tolerance / 10, **options
        )

    def losses_of(design: Design) -> NDArray[np.float64]:
        return np.array(
            [c.loss(own.of_spectrum(design.spectrum)) for c, own in zip(criteria, maps, strict=True)]
        )

    alone = [minimax(frozenset([j])) for j in range(J)]
    solved, floor = J, float(np.sort([design.bound for design in alone])[k - 1])
    best: tuple[float, Design, NDArray[np.float64]] | None = None
    # Nodes: bound, number (for ties), included, given up, an input that is optimal for the included.
    start = alone[int(np.argsort([design.bound for design in alone])[k - 1])]
    queue = [(floor, 0, frozenset[int](), frozenset[int](), start)]
    number, bound = 0, floor
    while queue:
        bound, _, inside, gone, design = heapq.heappop(queue)
        losses = losses_of(design)
        value = float(np.sort(losses)[k - 1])
        if best is None or value < best[0]:
            best = (value, design, losses)
        if best[0] <= bound * (1 + tolerance) or solved >= max_designs:
            break
        undecided = [j for j in range(J) if j not in inside and j not in gone]
        if undecided:
            worst = max(undecided, key=lambda j: losses[j])
            for more, less in ((inside | {worst}, gone), (inside, gone | {worst})):
                if len(less) > J - k:
                    continue
                chosen = frozenset(range(J)) - less if len(less) == J - k else more
                child = design
                if chosen != inside:
                    child, solved = minimax(chosen), solved + 1
                own = max(bound, child.bound if chosen else 0.0)
                if own < best[0]:
                    number += 1
                    heapq.heappush(queue, (own, number, chosen, less, child))
        bound = best[0]  # what holds if this was the last node
    if best is None:  # not reached: the first node sets it
        raise InputError("no design was computed; give at least one plant.")
    value, design, losses = best
    lower = min(max(bound, floor), value)
    kept = tuple(sorted(int(j) for j in np.argsort(losses, kind="stable")[:k]))
    status = Status.OK if value <= lower * (1 + tolerance) else Status.INACCURATE
    return QuantileDesign(design, losses, value, lower, kept, solved, status)
