"""One unit of work of a campaign."""

from __future__ import annotations

import dataclasses

import pytest

import benchmarks.campaign.one_part as runs
from benchmarks.campaign.settings import Settings


@pytest.mark.parametrize("plant", ["reference", "three-by-two"])
def test_noise_of_many_replicates_at_once_is_that_of_each(plant, monkeypatch):
    """A part of 70 replicates, two blocks of compiled noise, against the same part computed run by run."""
    settings = Settings(
        plants=(plant,),
        methods=("white",),
        estimators=("frf",),
        experiments=4,
        samples=130,
        profile_replicates=2,
    )
    part = runs.Part(plant, 1.0, "white", 100, 170)
    block = runs.run_part(settings, part)
    monkeypatch.setattr(runs, "SEVERAL_TENS", 1000)
    assert repr(block) == repr(runs.run_part(settings, part))
    monkeypatch.setattr(runs, "SEVERAL_TENS", 32)
    later = runs.run_part(settings, dataclasses.replace(part, start=101, stop=171))
    assert repr(later[:60]) == repr(block[1:61])  # wherever a block begins
    # The control: no two replicates meet the same noise.
    assert len({row["estimate"] for row in block[:70]}) == 70
