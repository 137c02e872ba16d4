"""Results are bound to what made them: content of files, settings, versions, the bits of a part."""

from __future__ import annotations

import json
import random
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import benchmarks.campaign.registry as methods
import benchmarks.campaign.store as store_module
import benchmarks.campaign.whole_campaign as campaign
import benchmarks.commands.record.diagnose_folder as diagnose_folder
import benchmarks.tables.statistics as statistics
from benchmarks.campaign.merging import merge_stores
from benchmarks.campaign.one_part import Part
from benchmarks.campaign.plants import content_of
from benchmarks.campaign.settings import Settings
from benchmarks.campaign.whole_campaign import fill_store, run_campaign, stored_runs
from benchmarks.cli import main
from benchmarks.page.skeleton import file_name
from benchmarks.tables.statistics import targets
from oed.errors import CampaignError, InputError
from oed.files.lock import locked
from oed.plants.norms import peak

SMALL = Settings(
    plants=("reference",), noise_variances=(1.0,), methods=("white", "power"), estimators=("frf",),
    samples=50, experiments=2, profile_replicates=0,
)  # fmt: skip
FLIPS = 150


def bits(runs) -> str:
    return repr([(r.key, [(k, e.estimate.tobytes(), e.statuses) for k, e in r.final.items()]) for r in runs])


def plant_file(folder: Path, gain: float) -> Path:
    file = folder / "p.json"
    file.write_text(json.dumps({"num": [[[0, gain]]], "den": [[[1, -0.5]]], "dt": 1}))
    return file


def test_an_edited_plant_file_is_another_campaign(tmp_path, monkeypatch):
    monkeypatch.setattr(
        statistics, "optimal_loss", lambda plant, criterion: peak(plant).value
    )  # quick, and of the content
    file = plant_file(tmp_path, 1.0)
    settings = lambda: replace(SMALL, plants=(str(file),))
    first = settings()
    whole = run_campaign(first, 2, tmp_path / "a", jobs=1)
    before = targets([(str(file), 1.0)])[str(file), 1.0]
    plant_file(tmp_path, 10.0)
    with pytest.raises(CampaignError, match=r"other settings \(the content of .*p.json\)"):
        run_campaign(settings(), 2, tmp_path / "a", jobs=1)
    with pytest.raises(CampaignError, match=r"p.json was changed while the campaign ran"):
        run_campaign(first, 7, tmp_path / "a", jobs=1)
    # nothing of the old content is left in this process
    after = targets([(str(file), 1.0)])[str(file), 1.0]
    assert np.isclose(after.gamma, 10 * before.gamma)
    assert np.isclose(statistics._optimum((str(file), content_of(str(file)), "D")), after.gamma)
    assert bits(run_campaign(settings(), 2, tmp_path / "b", jobs=1)) != bits(whole)
    plant_file(tmp_path, 1.0)
    assert bits(run_campaign(settings(), 2, tmp_path / "a", jobs=1)) == bits(whole)


def test_stores_of_two_contents_are_not_merged(tmp_path):
    for name, gain in (("a", 1.0), ("b", 2.0)):
        file = plant_file(tmp_path, gain)
        run_campaign(replace(SMALL, plants=(str(file),)), 2, tmp_path / name, jobs=1)
    with pytest.raises(CampaignError, match="had another content"):
        merge_stores([tmp_path / "a", tmp_path / "b"], tmp_path / "c")


@pytest.mark.parametrize("kind", ["seed", "over another", "version", "source"])
def test_a_part_from_elsewhere_is_named_and_computed_again(tmp_path, kind, capsys, monkeypatch):
    whole = run_campaign(SMALL, 2, tmp_path / "a", jobs=1)
    parts = sorted((tmp_path / "a" / "parts").iterdir())
    if kind == "seed":
        run_campaign(replace(SMALL, seed=1), 2, tmp_path / "b", jobs=1)
        shutil.copy(tmp_path / "b" / "parts" / parts[0].name, parts[0])
        words = "seed: there 1, asked 0"
    elif kind == "over another":
        shutil.copy(parts[1], parts[0])
        words = f"is the part {parts[1].stem} of a campaign"
    else:
        name = {"version": "numpy", "source": "source"}[kind]
        honest = store_module.versions()
        with monkeypatch.context() as patch:
            for module in (store_module, campaign):
                patch.setattr(module, "versions", lambda: honest | {name: "other"})
            run_campaign(SMALL, 2, tmp_path / "b", jobs=1)
        shutil.copy(tmp_path / "b" / "parts" / parts[0].name, parts[0])
        words = f"was made by other versions ({name}: there other"
    assert bits(run_campaign(SMALL, 2, tmp_path / "a", jobs=1)) == bits(whole)
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    "change",
    [{"given_up": 5, "time_limit": "x"}, {"given_up": "x"}, {"digest": 3}, {"versions": 3}, {"settings": {"contents": [3]}},
     {"key": []}, {"time_limit": []}],
    ids=str,
)  # fmt: skip
def test_a_part_that_says_nonsense_of_itself_is_computed_again(tmp_path, change, capsys):
    whole = run_campaign(SMALL, 2, tmp_path, jobs=1)
    path = sorted((tmp_path / "parts").iterdir())[0]
    with store_module.open_parquet(path) as file:
        table = store_module.read_columns(file)
    made = json.loads(table.schema.metadata[store_module.MADE]) | change
    altered = table.replace_schema_metadata({store_module.MADE: json.dumps(made).encode()})
    path.write_bytes(store_module.table_bytes(altered))
    assert bits(run_campaign(SMALL, 2, tmp_path, jobs=1)) == bits(whole)
    assert f"{path.name} is" in capsys.readouterr().err


@pytest.mark.parametrize("content", ["3", "[3]", '{"a": {}, "b": 3}', "null"])
def test_settings_that_are_none_are_no_campaign(tmp_path, content):
    run_campaign(SMALL, 2, tmp_path, jobs=1)
    file = tmp_path / "campaign.json"
    for name in ("contents", "sources"):
        said = json.loads(file.read_text())
        file.write_text(json.dumps(said | {"settings": said["settings"] | {name: json.loads(content)}}))
        with pytest.raises(CampaignError, match="no readable campaign.json|other settings"):
            run_campaign(SMALL, 2, tmp_path, jobs=1)


@pytest.mark.parametrize("content", ["{", "[]", '{"wall_seconds": {}}', "[" * 100_000])
def test_a_damaged_account_of_the_cost_begins_anew(tmp_path, content):
    from benchmarks.comparison import _add_cost

    (tmp_path / "cost.json").write_text(content)
    _add_cost(tmp_path, 2.5, 1)
    _add_cost(tmp_path, 1.0, 1)
    assert json.loads((tmp_path / "cost.json").read_text())["wall_seconds"] == 3.5


def test_no_flipped_bit_changes_a_number(tmp_path):
    """Checksums of pages do not cover a file's end, the digest of the values does not cover its metadata: together all."""
    store = fill_store(SMALL, 2, tmp_path, jobs=1)
    path = sorted(store.parts.iterdir())[0]
    good, content = repr(store.read(path.stem).to_pydict()), path.read_bytes()
    draw, lost = random.Random(5), 0
    for _ in range(FLIPS):
        damaged = bytearray(content)
        damaged[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
        path.write_bytes(damaged)
        found = store.read(path.stem)
        lost += found is None
        assert found is None or repr(found.to_pydict()) == good
    assert lost > FLIPS // 2


def test_what_was_given_up_is_tried_again_with_more_time(tmp_path, monkeypatch, capsys):
    import time

    def slow(trace):
        time.sleep(0.4)
        return methods.Estimate(1.0)

    monkeypatch.setitem(methods.ESTIMATORS, "slow", methods.Estimator(slow, ""))
    settings = replace(SMALL, methods=("white",), estimators=("slow",))
    first = run_campaign(settings, 2, tmp_path, jobs=1, time_limit=0.1)
    assert first[0].final["slow"].statuses == {"TIME_LIMIT": 2}
    again = run_campaign(settings, 2, tmp_path, jobs=1, time_limit=0.1)
    assert bits(again) == bits(first)
    assert "tried again" not in capsys.readouterr().err
    lifted = run_campaign(settings, 2, tmp_path, jobs=1, time_limit=30)
    assert lifted[0].final["slow"].statuses == {"OK": 2}
    assert "2 results were given up after 0.1 s and are tried again" in capsys.readouterr().err


def test_a_worker_with_other_source_is_refused(tmp_path, monkeypatch):
    honest = campaign._with_part

    def altered(*given):
        part, rows, made = honest(*given)
        return part, rows, made | {"source": "other"}

    monkeypatch.setattr(campaign, "_with_part", altered)
    with pytest.raises(
        CampaignError,
        match="a worker runs other versions or other source than this process .source: there other",
    ):
        run_campaign(SMALL, 2, tmp_path, jobs=1)
    assert not list((tmp_path / "parts").iterdir())


def test_the_source_digest_sees_what_decides_and_not_what_shows(tmp_path, monkeypatch):
    import oed

    root = Path(oed.__file__).parent.parent
    for package in ("oed", "estimators", "benchmarks"):
        shutil.copytree(
            root / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "data")
        )
    monkeypatch.setattr(oed, "__file__", str(tmp_path / "oed" / "__init__.py"))
    digest = store_module.source_digest.__wrapped__
    before = digest()
    assert before == store_module.source_digest()
    shown = next((tmp_path / "benchmarks").rglob("report.py"))
    shown.write_text(shown.read_text() + "# another colour")
    assert digest() == before
    decides = tmp_path / "oed" / "errors.py"
    decides.write_text(decides.read_text() + "# another rule")
    assert digest() != before


def test_two_processes_do_not_work_in_one_folder(tmp_path):
    store = fill_store(SMALL, 2, tmp_path, jobs=1)
    left = store.parts / ".123-0.tmp"
    left.write_bytes(b"half")
    with (
        locked(tmp_path / "lock", "x"),
        pytest.raises(CampaignError, match="another process .* is working in the campaign"),
    ):
        fill_store(SMALL, 2, tmp_path, jobs=1)
    assert left.exists(), "only who holds the lock tidies"
    list(stored_runs(fill_store(SMALL, 2, tmp_path, jobs=1), SMALL, 2))
    assert not left.exists()


def test_a_plant_in_a_folder_has_figures_of_its_name(tmp_path, monkeypatch):
    from benchmarks.comparison import compare

    (tmp_path / "dir").mkdir()
    plant_file(tmp_path, 1.0).rename(tmp_path / "dir" / "p.json")
    monkeypatch.chdir(tmp_path)
    found = compare(plants=["dir/p.json"], noise_variances=[1.0], methods=["white"], estimators=["frf"], samples=50,
                    experiments=2, replicates=2, jobs=1, quiet=True, out=tmp_path / "o")  # fmt: skip
    assert found.page.exists()


@pytest.mark.parametrize("name", ["q" * 250 + ".json", "a/../b.json", "ü\n\0.json", "reference"])
def test_names_of_files_are_such_that_every_system_takes_them(name):
    made = [file_name(f"efficiency-{name}"), Part(name, 1.0, f"{name}:f", 0, 5).key]
    assert all(re.fullmatch(r"[\w.+-]{1,200}", text, flags=re.ASCII) for text in made)
    assert file_name(name) != file_name(name + "x")


def test_estimators_for_none_of_the_inputs_are_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match="made for other inputs .rayleigh for power"):
        run_campaign(replace(SMALL, methods=("white",), estimators=("rayleigh",)), 2, tmp_path / "o", jobs=1)
    assert not (tmp_path / "o").exists()


class Told:
    """Stands for a diagnosis: it says how long its training record is."""

    def __init__(self, length: int) -> None:
        self.length = length

    def to_dict(self) -> dict:
        return {"effect": f"n{self.length}"}


@pytest.fixture
def cases(tmp_path, monkeypatch):
    import estimators.diagnosis.cases as module

    def told(train, test, meta):
        text = Path(train).read_text()
        if "bad" in text:
            raise ValueError("it is bad")
        return Told(len(text)), []

    monkeypatch.setattr(module, "diagnose_files", told)
    for name in ("a", "b"):
        (tmp_path / "P" / name).mkdir(parents=True)
        (tmp_path / "P" / name / "train.csv").write_text("u,y\n1,2\n")
    return tmp_path


def diagnosed(folder: Path, *more: str) -> tuple[int, dict]:
    out = folder / "r.jsonl"
    code = main(["diagnose-folder", str(folder / "P"), "--out", str(out), "--jobs", "1", "--quiet", *more])
    lines = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    return code, {line["case"]: line["effect"] for line in lines}


def test_cases_are_bound_to_their_files(cases, capsys):
    assert diagnosed(cases) == (0, {"a": "n8", "b": "n8"})
    assert diagnosed(cases) == (0, {"a": "n8", "b": "n8"})
    assert "diagnosed again" not in capsys.readouterr().err
    (cases / "P" / "a" / "train.csv").write_text("u,y\n1,2\n3,4\n")
    assert diagnosed(cases) == (0, {"a": "n12", "b": "n8"})
    assert "1 lines of" in capsys.readouterr().err
    assert json.loads((cases / "r.jsonl.before").read_text())["effect"] == "n8", "nothing is lost"


def test_a_failed_case_is_exit_1_and_tried_again(cases):
    (cases / "P" / "a" / "train.csv").write_text("bad")
    assert diagnosed(cases) == (1, {"b": "n8"})
    (cases / "P" / "a" / "train.csv").write_text("u,y\n")
    assert diagnosed(cases) == (0, {"a": "n4", "b": "n8"})


def test_cases_of_another_version_are_done_again(cases, monkeypatch):
    diagnosed(cases)
    monkeypatch.setattr(diagnose_folder, "_version", lambda: "other")
    diagnosed(cases)
    assert len((cases / "r.jsonl.before").read_text().splitlines()) == 2
    assert len((cases / "r.jsonl").read_text().splitlines()) == 2


def test_an_answer_that_was_edited_is_done_again(cases, capsys):
    """The digests of its files and version stood, and it was believed."""
    diagnosed(cases)
    out = cases / "r.jsonl"
    out.write_text(out.read_text().replace('"effect": "n8"', '"effect": "n9"', 1))
    assert diagnosed(cases) == (0, {"a": "n8", "b": "n8"})
    assert "changed since" in capsys.readouterr().err
    assert json.loads((cases / "r.jsonl.before").read_text())["effect"] == "n9"


@pytest.mark.parametrize(
    "text", ["u,y\n1,2\n", "precious", '{"case": ["a"], "effect": 1}\n', '{"note": 1}\n', '{"case": 5}\n']
)
def test_a_file_that_is_no_result_is_not_written_over(cases, capsys, text):
    """A record given as --out by mistake was emptied."""
    (cases / "r.jsonl").write_text(text)
    assert main(["diagnose-folder", str(cases / "P"), "--out", str(cases / "r.jsonl"), "--jobs", "1"]) == 2
    assert (cases / "r.jsonl").read_text() == text
    assert "line 1 of" in capsys.readouterr().err


def test_a_cut_line_is_done_again_and_a_second_process_refused(cases, capsys):
    diagnosed(cases)
    out = cases / "r.jsonl"
    out.write_bytes(out.read_bytes()[:-20])
    assert diagnosed(cases) == (0, {"a": "n8", "b": "n8"})
    with locked(cases / ".r.jsonl.lock", "x"):
        assert diagnosed(cases)[0] == 2
    assert "another process" in capsys.readouterr().err


def test_a_folder_from_before_contents_were_kept_says_so():
    """It had said "other settings (the content of )"."""
    said = store_module.difference({"seed": 0}, {"seed": 0, "contents": []})
    assert said == "an older version wrote it, without contents"
