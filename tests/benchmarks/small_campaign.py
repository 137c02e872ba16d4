"""A campaign of seconds, and whether two gave the same bits."""

from __future__ import annotations

import numpy as np

from benchmarks.campaign.settings import Settings

SMALL = Settings(
    plants=("reference",),
    noise_variances=(1.0,),
    methods=("white", "power"),
    estimators=("gain", "mu", "frf"),
    samples=100,
    experiments=3,
    profile_replicates=2,
)


def plain(runs: list) -> str:
    """Every bit of the runs of a campaign as text; NaN equals NaN."""
    return repr(
        [
            (r.key, [(k, [c.tolist() for c in vars(e).values() if isinstance(c, np.ndarray)], e.statuses, e.messages)
             for k, e in [*r.final.items(), *r.earlier.items()]], r.information)
            for r in runs
        ]
    )  # fmt: skip


def same(a: list, b: list) -> bool:
    """Bit-identical runs."""
    return plain(a) == plain(b)
