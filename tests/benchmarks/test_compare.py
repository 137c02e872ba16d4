"""The main job end to end on a small size: tables, figures, page, README; and the hair dryer's story."""

from __future__ import annotations

import json
import re
from html import escape

import numpy as np
import pytest

from benchmarks.cli import main
from benchmarks.comparison import Comparison, compare
from benchmarks.page import comparison
from benchmarks.page.skeleton import write_report
from benchmarks.readme import END, START, with_headline, write_readme
from benchmarks.tables.columns import headings
from benchmarks.tables.formats import from_parquet
from benchmarks.tables.hair_dryer import hair_dryer_story
from oed.errors import CampaignError, InputError

SIZE = {
    "plants": ["reference"],
    "noise_variances": [1.0, 9.0],
    "samples": 200,
    "experiments": 4,
    "replicates": 6,
    "profile_replicates": 2,
    "methods": ["white", "multisine", "power", "procedure-2", "oracle-D", "oracle-hinf"],
    "estimators": ["rayleigh", "gain", "mu", "pem"],
    "quiet": True,
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "HEAD_TO_HEAD_PLANTS", 6)
        patch.setattr(comparison, "FIG3_REPLICATES", 20)
        early = []
        look = lambda result: early.append((result, (folder / "figures").exists(), result.page))
        result = compare(**SIZE, out=folder, jobs=1, tell=look)
        ((told, drawn, page),) = early  # the answer comes before the figures
        assert not drawn
        assert page is None
        assert told.sentences == result.sentences[: len(told.sentences)]
        assert told.rows == result.rows
        yield folder, result


@pytest.mark.slow
def test_every_row_has_its_keys_and_errors(finished):
    _, result = finished
    keys = "plant noise_variance method estimator samples experiments energy rho rho_se bias bias_se rmse rmse_se"
    keys += " c_efficiency d_efficiency a_efficiency e_efficiency n n_failed"
    payload = json.loads(json.dumps(result.to_dict()["rows"]))
    assert len(payload) == 2 * (4 + 3 + 4)  # two noise levels; power, procedure-2, and four inputs with PEM
    for row in payload:
        assert set(keys.split()) <= set(row)
        assert row["samples"] == 800
        assert np.isclose(row["energy"], 800)
        assert 0 <= row["c_efficiency"] <= 1 + 1e-6
        assert row["n"] == SIZE["replicates"]


@pytest.mark.slow
def test_files_of_a_comparison(finished):
    folder, result = finished
    for name in (
        "comparison",
        "information",
        "headline",
        "answer",
        "advice",
        "growth",
        "pairs",
        "performance",
        "head_to_head",
    ):
        for suffix in (".parquet", ".csv", ".md", ".tex"):
            assert (folder / "tables" / f"{name}{suffix}").stat().st_size > 100
        assert r"\toprule" in (folder / "tables" / f"{name}.tex").read_text()
        _, metadata = from_parquet(folder / "tables" / f"{name}.parquet")
        assert metadata["command"].startswith("oed compare --plant reference")
        assert "version of numpy" in metadata
    for name in (
        "answer-where",
        "answer-advice",
        "growth",
        "profiles",
        "profiles-data",
        "head-to-head",
        "rho",
        "efficiency-reference",
        "limit-spectra-reference",
        "spectra-reference",
        "estimated-gain-reference",
    ):
        assert (folder / "figures" / f"{name}.svg").read_text().startswith("<?xml")
        assert (folder / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    page = (folder / "report.html").read_text()
    head = page[: page.index("<script")]
    assert head.count("<figure") == 12
    assert "connect-src 'none'" in head
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]+"', head)  # it opens offline
    identifiers = re.findall(r'\bid="([^"]+)"', head)
    assert len(identifiers) == len(set(identifiers))
    assert all(escape(sentence) in page for sentence in result.sentences)
    assert len(page.encode()) < 2e6


@pytest.mark.slow
def test_a_row_is_repeated_by_its_command(finished, tmp_path):
    """What the button of a row shows is a command that makes the same numbers."""
    folder, result = finished
    content = json.loads((folder / "report.json").read_text())
    row = next(
        r for r in result.rows if (r["noise_variance"], r["method"], r["estimator"]) == (9.0, "white", "pem")
    )
    words = f"--plant {row['plant']} --noise-variance 9 --methods white --estimators pem {content['repeat']['rest']}"
    words = words.replace("results/again", str(tmp_path / "again")).split()
    assert main(["compare", *words, "--quiet"]) == 0
    (again,) = from_parquet(tmp_path / "again/tables/comparison.parquet")[0]
    assert {key: again[key] for key in ("rho", "bias", "c_efficiency", "n")} == {
        key: row[key] for key in ("rho", "bias", "c_efficiency", "n")
    }
    assert list(folder.glob(content["runs"]["reference|9|white"]))


@pytest.mark.slow
def test_the_same_settings_give_the_same_tables(finished, tmp_path):
    folder, result = finished
    again = compare(**SIZE, out=tmp_path / "b", jobs=2)
    assert repr(again.rows) == repr(result.rows)
    assert repr(again.information) == repr(result.information)
    assert repr(again.pairs) == repr(result.pairs)
    assert (
        from_parquet(folder / "tables/comparison.parquet")[0].__repr__()
        == from_parquet(tmp_path / "b/tables/comparison.parquet")[0].__repr__()
    )


@pytest.mark.slow
def test_the_page_can_be_made_again(finished):
    folder, _ = finished
    page = (folder / "report.html").read_text()
    (folder / "report.html").unlink()
    assert write_report(folder).read_text() == page


def test_a_folder_without_a_report_is_refused(tmp_path):
    with pytest.raises(InputError, match="has no report.json"):
        write_report(tmp_path)
    (tmp_path / "report.json").write_text("{")
    with pytest.raises(CampaignError, match="is not JSON"):
        write_report(tmp_path)


@pytest.mark.slow
def test_readme_is_written_from_the_results(finished, tmp_path):
    folder, _ = finished
    readme = tmp_path / "README.md"
    readme.write_text(f"# x\n\n{START}\nold\n{END}\n\nrest\n")
    write_readme(folder, readme)
    text = readme.read_text()
    assert "old" not in text
    assert "rest" in text
    assert "| reference" in text
    assert "not in print" in text
    for name in ("efficiency", "answer-where", "answer-advice"):
        assert (tmp_path / "docs" / f"{name}.svg").read_text().startswith("<?xml")
    with pytest.raises(InputError, match="lacks the marks"):
        with_headline("# x", "table")


def test_dry_run_writes_nothing(tmp_path):
    result = compare(
        plants=["reference"], methods=["white"], noise_variances=[1.0], out=tmp_path / "x", dry_run=True
    )
    assert "Dry run: 1 combination" in result.sentences[0]
    with pytest.raises(InputError, match="no estimator asked for can be applied to the records of white"):
        compare(
            plants=["reference"], methods=["white"], estimators=["gain"], out=tmp_path / "x", dry_run=True
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_comparison_in_which_every_run_fails_still_reports(tmp_path):
    def unplugged(experiment, *, samples, iterations, rng):
        raise RuntimeError("the cable is out")

    options = {"plants": ["reference"], "noise_variances": [1.0], "estimators": ["frf"], "samples": 50}
    options |= {"experiments": 2, "methods": [unplugged], "jobs": 1, "quiet": True}
    dry = compare(**options, dry_run=True, out=tmp_path / "none")
    assert "unplugged, frf: RuntimeError: the cable is out" in dry.sentences[1]
    result = compare(**options, replicates=2, out=tmp_path / "failed")
    assert [(r["n"], r["n_failed"], r["failures"]) for r in result.rows] == [(2, 2, "2 failed")]
    assert result.page.exists()


@pytest.mark.slow
def test_a_random_plant_alone_is_on_the_page(tmp_path):
    """The page hides the plants of a family; where no iterations put them together it had said that no run gave a number."""
    result = compare(
        plants=["random-fir-1"], noise_variances=[1.0], methods=["white"], estimators=["fir-selected"], samples=100,
        experiments=2, replicates=2, profile_replicates=0, jobs=1, quiet=True, out=tmp_path,
    )  # fmt: skip
    assert result.sentences[0].startswith("Of the inputs compared, white carries most for the peak gain: ")
    assert "| random-fir-1 |" in (tmp_path / "summary.md").read_text()


def test_hair_dryer_story():
    """Issue: input-correlated residuals at lags 1 to 3 with nk = 1, then nk = 3; simulation about 0.145 to 0.116 V."""
    story = hair_dryer_story()
    assert {1, 2, 3} <= set(story.suspicious_lags)
    assert story.delay == 3
    before, after = story.rows
    assert abs(before["simulation_rmse"] - 0.145) < 0.003
    assert abs(after["simulation_rmse"] - 0.116) < 0.003
    assert after["one_step_rmse"] < 0.5 * before["one_step_rmse"]
    assert before["smallest_p_value"] < 1e-20


def test_a_comparison_without_sentences_prints_its_table_once(monkeypatch, tmp_path, capfd):
    row = dict.fromkeys(headings("comparison"), 0.0) | {"plant": "mine.json"}
    result = lambda page: Comparison([row], [], tmp_path, page, [])

    def stands_in(tell, **options):
        tell(result(None))
        return result(tmp_path / "report.html")

    monkeypatch.setattr("benchmarks.comparison.compare", stands_in)
    assert main(["compare", "--quiet"]) == 0
    said = capfd.readouterr().out
    assert said.count("mine.json") == 1
    assert said.endswith("report.html\n")
