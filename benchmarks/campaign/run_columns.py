"""The runs of one combination of plant, noise and input as columns, from the parts of a store."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from oed.errors import Status

if TYPE_CHECKING:
    import pyarrow as pa

NUMBERS = ("replicate", "experiments", "samples", "energy", "peak_amplitude", "estimate", "standard_error")
UNUSABLE = (Status.FAILED.name, Status.TIME_LIMIT.name)


@dataclass(frozen=True, eq=False)
class Estimates:
    """All estimates of one estimator, in the order of the replicates. `replicate, experiments, samples,
    energy, peak_amplitude, estimate, standard_error` (R,) columns of the store; `good` (R,) whether there is
    a number that counts: not where its own standard error is above it, by which the estimator says itself that the
    records do not determine the norm; `statuses` how often each status occurred; `messages` different messages, the first
    few."""

    replicate: NDArray[np.float64]
    experiments: NDArray[np.float64]
    samples: NDArray[np.float64]
    energy: NDArray[np.float64]
    peak_amplitude: NDArray[np.float64]
    estimate: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    good: NDArray[np.bool_]
    statuses: dict[str, int]
    messages: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.replicate)

    @property
    def spent(self) -> dict[str, float]:
        """What a run cost: samples, experiments and peak_amplitude (the largest of any run), energy (the mean)."""
        energy = self.energy[np.isfinite(self.energy)]
        amplitude = self.peak_amplitude[np.isfinite(self.peak_amplitude)]
        return {
            "samples": int(self.samples.max(initial=0)),
            "experiments": int(self.experiments.max(initial=0)),
            "energy": float(energy.mean()) if len(energy) else float("nan"),
            "peak_amplitude": float(amplitude.max()) if len(amplitude) else float("nan"),
        }


@dataclass(frozen=True, eq=False)
class Runs:
    """One combination. `plant, noise_variance, method` which; `final` estimator to its Estimates with the
    whole budget; `earlier` (estimator, experiments) to its Estimates after a part of the budget;
    `information` per part and checkpoint: experiments, samples, energy, peak_amplitude, count and the sum of
    the information."""

    plant: str
    noise_variance: float
    method: str
    final: Mapping[str, Estimates]
    earlier: Mapping[tuple[str, int], Estimates]
    information: tuple[dict[str, Any], ...]

    @property
    def key(self) -> tuple[str, float, str]:
        """Plant, noise variance and method."""
        return self.plant, self.noise_variance, self.method


def runs_of(combination: tuple[str, float, str], tables: Sequence[pa.Table]) -> Runs:
    """Columns of one combination."""
    import pyarrow as pa
    import pyarrow.compute as pc

    information: list[dict[str, Any]] = []
    kept = []
    for table in tables:
        carried = pc.equal(table["estimator"], "")
        information += [row for row in table.filter(carried).to_pylist() if row["count"]]  # others: it failed
        kept.append(table.filter(pc.invert(carried)).drop_columns(["information", "plant", "method"]))
    whole = pa.concat_tables(kept)
    names = whole["estimator"].combine_chunks().dictionary_encode()
    final_flags = whole["final"].to_numpy(zero_copy_only=False)
    codes, used = names.indices.to_numpy(zero_copy_only=False), whole["experiments"].to_numpy()
    final: dict[str, Estimates] = {}
    earlier: dict[tuple[str, int], Estimates] = {}
    for code, name in enumerate(names.dictionary.to_pylist()):
        mine = codes == code
        final[name] = _estimates(whole, mine & final_flags)
        cut = mine & ~final_flags
        for k in np.unique(used[cut]):
            earlier[name, int(k)] = _estimates(whole, cut & (used == k))
    return Runs(*combination, final, earlier, tuple(information))


def _estimates(table: pa.Table, chosen: NDArray[np.bool_]) -> Estimates:
    import pyarrow.compute as pc

    mine = table.take(np.flatnonzero(chosen))
    columns = {name: np.asarray(mine[name].to_numpy(), dtype=float) for name in NUMBERS}
    status = np.asarray(mine["status"].to_pylist(), dtype=object)
    with np.errstate(invalid="ignore"):  # NaN where an estimator states no error
        lost = columns["standard_error"] > np.abs(columns["estimate"])
    status[lost] = Status.SINGULAR.name
    messages = [text for text in pc.unique(mine["message"]).to_pylist() if text]
    return Estimates(
        **columns,
        good=np.isfinite(columns["estimate"]) & ~lost & ~np.isin(status, UNUSABLE),
        statuses=dict(sorted(Counter(status.tolist()).items())),
        messages=tuple(messages[:5]),
    )
