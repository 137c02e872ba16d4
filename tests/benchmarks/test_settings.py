"""Campaigns from TOML files, one's own methods, and stores put together."""

from __future__ import annotations

import textwrap
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from benchmarks.campaign.merging import merge_stores
from benchmarks.campaign.one_part import parts
from benchmarks.campaign.plants import expanded, family_of
from benchmarks.campaign.settings import Limit, Settings, campaign_from_toml, default_limits, limit_from_text
from benchmarks.campaign.users_own import Own
from benchmarks.campaign.whole_campaign import fill_store, run_campaign, stored_runs
from benchmarks.cli import main
from benchmarks.comparison import compare
from oed.errors import CampaignError, InputError
from oed.plants.families import FAMILIES

PUBLISHED = Path(__file__).resolve().parents[2] / "benchmarks" / "campaigns" / "published.toml"


def test_the_published_campaign_is_what_it_says():
    """8 plants at 3 noise levels, 40 random ones of each of 5 families at one; 10000 samples in all per run."""
    given = campaign_from_toml(PUBLISHED)
    assert given["samples"] * given["experiments"] == 10000
    options = {k: v for k, v in given.items() if k not in ("replicates", "time_limit", "out")}
    settings = Settings(**options | {"plants": expanded(given["plants"])})
    families = Counter(map(family_of, settings.plants))
    assert families == {f"random-{name}": 40 for name in ("fir", *FAMILIES)} | {"": 8}
    runs = partial(settings.replicates_of, 200)
    assert runs("reference", "white", "pem", 1.0) == 200
    assert runs("reference", "oracle-D", "pem-selected", 1.0) == 0
    assert runs("random-light-3", "white", "pem", 1.0) == 4
    assert runs("random-light-3", "white", "pem", 9.0) == 0
    assert runs("random-many-3", "procedure-2", "corrected", 1.0) == 4
    assert {p.plant for p in parts(settings, 2) if p.method == "procedure-2"} == {
        "three-by-two", *(name for name in settings.plants if family_of(name) == "random-many")
    }  # fmt: skip


def test_the_reason_of_a_limit_binds_nothing():
    """A store made before a reason was written is resumed after."""
    without, with_reason = (
        Settings(plants=("reference",), limits=(Limit(0, method="power", why=why),)) for why in ("", "time")
    )
    assert without == with_reason
    assert without.deciding() == with_reason.deciding()
    assert with_reason.why_not("reference", "power") == "time"
    assert (
        without.deciding() != Settings(plants=("reference",), limits=(Limit(1, method="power"),)).deciding()
    )


def test_a_limit_of_many_plants_at_one_noise_level():
    """A pattern limits the plants that it names at the level that it names, and nothing else."""
    limit = limit_from_text("replicates=1,plant=random-light-*,noise_variance=9")
    settings = Settings(plants=("reference", *expanded(["random-light-1..2"])), limits=(limit,))
    assert settings.replicates_of(5, "random-light-2", "white", noise_variance=9.0) == 1
    assert settings.replicates_of(5, "random-light-2", "white", noise_variance=4.0) == 5
    assert settings.replicates_of(5, "reference", "white", noise_variance=9.0) == 5
    with pytest.raises(InputError, match="plant of a limit"):
        Settings(limits=(Limit(1, plant="random-many-*"),))


@pytest.mark.parametrize(
    "text, words",
    [
        ("plants = [", "not TOML"),
        ("plant = ['reference']", "the key 'plant' is unknown .did you mean plants"),
        ("plants = 'reference'", "plants is 'reference'; it must be a list"),
        ("samples = '100'", "samples is '100'; it must be a whole number"),
        ("samples = true", "samples is True; it must be a whole number"),
        ("noise_variances = ['a']", "noise_variances.0. is 'a'; it must be a number"),
        ("[[limit]]\nplant = 'reference'", "limit.0..replicates. is missing"),
        ("[[limit]]\nreplicates = 3\nrobot = 'x'", "the key 'robot' in limit.0. is unknown"),
        ("[[limit]]\nreplicates = -3", "-3 replicates"),
    ],
)
def test_a_wrong_file_is_refused_in_words(tmp_path, text, words):
    file = tmp_path / "c.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=words):
        campaign_from_toml(file)


def test_a_campaign_runs_only_code_that_lies_beside_it(tmp_path, capsys):
    """And says which."""
    (tmp_path / "c").mkdir()
    outside, beside = tmp_path / "mine.py", tmp_path / "c" / "mine.py"
    code = "def mine(trace, plant):\n    return 2.0\n"
    outside.write_text(code)
    file = tmp_path / "c" / "c.toml"
    for path in (str(outside), "../mine.py"):
        file.write_text(f'estimators = ["{path}:mine"]')
        with pytest.raises(
            InputError, match="does not lie beside it; put it there, or name it on the command line"
        ):
            campaign_from_toml(file)
    beside.symlink_to(outside)
    file.write_text('plants = ["reference"]\nmethods = ["white"]\nestimators = ["mine.py:mine"]')
    with pytest.raises(InputError, match="does not lie beside it"):
        campaign_from_toml(file)
    beside.unlink()
    beside.write_text(code)
    assert campaign_from_toml(file)["estimators"] == (f"{beside}:mine",)
    assert (
        main(["compare", "--config", str(file), "--dry-run", "--samples", "50", "--jobs", "1", "--quiet"])
        == 0
    )
    assert f"running the code in {beside}" in capsys.readouterr().err


def test_a_file_that_is_not_there():
    with pytest.raises(InputError, match=r"nowhere.toml cannot be read \(No such file"):
        campaign_from_toml("nowhere.toml")


def test_a_limit_as_the_command_line_takes_it():
    assert limit_from_text("replicates=3,estimator=pem") == Limit(3, estimator="pem")
    for text in ("estimator=pem", "replicates=x", "replicates=-1"):
        with pytest.raises(InputError, match="give replicates=R"):
            limit_from_text(text)
    with pytest.raises(InputError, match="did you mean gain"):
        Settings(limits=(Limit(1, estimator="gian"),))


def test_the_command_line_goes_before_the_file(tmp_path, capsys):
    file = tmp_path / "c.toml"
    file.write_text(
        "plants = ['delay']\nnoise_variances = [4]\nmethods = ['white']\nestimators = ['frf']\nsamples = 50\nexperiments = 2\n"
    )
    assert main(["compare", "--config", str(file), "--plant", "reference", "--dry-run", "--quiet"]) == 0
    assert "Dry run: 1 combinations" in capsys.readouterr().out
    assert main(["compare", "--config", str(file), "--samples", "3", "--dry-run"]) == 2
    assert "samples is 3" in capsys.readouterr().err


def test_default_limits_concern_what_is_compared():
    assert Limit(10, plant="three-by-two") in default_limits(["three-by-two"], ["white"], ["pem"])
    assert default_limits(["reference"], ["white"], ["pem"]) == ()
    blank = Settings()
    everything = default_limits(blank.plants, blank.methods, blank.estimators)
    settings = Settings(limits=everything)
    assert settings.replicates_of(100, "reference", "procedure-2") == 0
    assert settings.replicates_of(100, "reference", "power", "mu") == 100
    assert settings.replicates_of(100, "reference", "power", "pem") == 60
    assert settings.replicates_of(100, "three-by-two", "procedure-2") == 10


OWN = textwrap.dedent("""
    import numpy as np

    def alternating(samples, n_inputs, n_outputs, rng):
        while True:
            y = yield np.tile([[1.0], [-1.0]], (samples // 2, n_inputs))

    def loudest(trace, plant):
        return max(float(abs(r.y).max()) for r in trace.records)
""")
TINY = {
    "noise_variances": (1.0,),
    "estimators": ("gain", "frf"),
    "samples": 50,
    "experiments": 2,
    "profile_replicates": 0,
}


def test_methods_and_estimators_of_ones_own(tmp_path):
    """From a file, in two worker processes that never import it; and the same as functions."""
    file = tmp_path / "mine.py"
    file.write_text(OWN)
    own = Own(["white", f"{file}:alternating"], [f"{file}:loudest"])
    settings = Settings(
        plants=("reference",),
        noise_variances=(1.0,),
        methods=own.methods,
        estimators=own.estimators,
        samples=50,
        experiments=2,
        profile_replicates=0,
        sources=tuple(own.sources),
    )
    raw = run_campaign(settings, 6, tmp_path / "a", jobs=2, own=own.functions)
    mine = next(r for r in raw if r.method.endswith(":alternating"))
    found = mine.final[f"{file}:loudest"]
    assert np.allclose(found.energy, 100)
    assert np.all(found.estimate > 1)
    file.write_text(OWN.replace("1.0", "2.0"))
    other = Own(["white", f"{file}:alternating"], [f"{file}:loudest"])
    assert other.sources != own.sources  # a store of the old function would not be continued


def test_a_function_is_a_method_too(tmp_path):
    def steps(samples, n_inputs, n_outputs, rng):
        while True:
            yield np.ones((samples, n_inputs))

    result = compare(
        plants=["reference"],
        methods=[steps, "white"],
        estimators=["frf"],
        noise_variances=[1.0],
        dry_run=True,
    )
    assert "Dry run: 2 combinations" in result.sentences[0]
    for spec, words in (
        (f"{tmp_path}/no.py:f", "cannot be read"),
        (f"{__file__}:nothing", "has no function nothing"),
        (3, "is no method"),
    ):
        with pytest.raises(InputError, match=words):
            Own([spec], [])


def test_merged_stores_are_one_campaign(tmp_path):
    """Two machines with different plants and replicates; what neither has is computed; bit for bit as in one go."""
    one = Settings(plants=("reference",), methods=("white", "power"), **TINY)
    two = Settings(plants=("delay",), methods=("white",), **TINY)
    fill_store(one, 5, tmp_path / "one", jobs=1)
    fill_store(two, 10, tmp_path / "two", jobs=1)
    merged = merge_stores([tmp_path / "one", tmp_path / "two"], tmp_path / "both")
    replicates = merged.pop("replicates")
    assert (replicates, merged.pop("out")) == (10, str(tmp_path / "both"))
    together = Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in merged.items()})
    assert together.plants == ("reference", "delay")
    stamps = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "both" / "parts").iterdir()}
    assert len(stamps) == 4
    store = fill_store(together, replicates, tmp_path / "both", jobs=1)
    assert {n: (store.parts / n).stat().st_mtime_ns for n in stamps} == stamps
    whole = fill_store(together, replicates, tmp_path / "whole", jobs=1)
    text = lambda s: repr([(r.key, [e.estimate.tolist() for e in r.final.values()], r.information)
                           for r in stored_runs(s, together, replicates)])  # fmt: skip
    assert text(store) == text(whole)


def test_stores_that_do_not_belong_together(tmp_path):
    fill_store(Settings(plants=("reference",), methods=("white",), **TINY), 2, tmp_path / "one", jobs=1)
    other = TINY | {"samples": 60}
    fill_store(Settings(plants=("delay",), methods=("white",), **other), 2, tmp_path / "two", jobs=1)
    with pytest.raises(CampaignError, match=r"different samples; .*Nothing was written"):
        merge_stores([tmp_path / "one", tmp_path / "two"], tmp_path / "both")
    assert not (tmp_path / "both").exists()
    with pytest.raises(InputError, match=r"no readable campaign.json"):
        merge_stores([tmp_path], tmp_path / "both")


def test_a_whole_number_written_with_an_exponent(tmp_path):
    """1e3 is an integer to a schema and a float to Python: 40,000.0 samples stood in the report."""
    file = tmp_path / "c.toml"
    file.write_text("samples = 1e3\n[[limit]]\nreplicates = 2.0\n")
    found = campaign_from_toml(file)
    assert repr((found["samples"], found["limits"][0].replicates)) == "(1000, 2)"
    with pytest.raises(InputError, match="samples is 1000.5; it must be a whole number of at least 10"):
        Settings(samples=1000.5)  # type: ignore[arg-type]
