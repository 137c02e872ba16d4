"""Tables of results: digits by the standard error, escaping, and nothing lost in the files."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from benchmarks.campaign.run_columns import runs_of
from benchmarks.tables.formats import (
    escape_latex,
    format_value,
    from_parquet,
    to_csv,
    to_latex,
    to_markdown,
    to_parquet,
    to_text,
)
from oed.errors import InputError

ROWS = [
    {"plant": "hair_dryer", "rho": 1.23456, "rho_se": 0.0123, "n": 100, "holds": True, "c_efficiency": 0.5},
    {"plant": "a|b & 100%", "rho": None, "rho_se": None, "n": 7, "holds": False, "c_efficiency": math.nan},
]


@pytest.mark.parametrize(
    "value, se, shown",
    [
        (1.23456, 0.0123, "1.235 ± 0.012"),
        (1.23456, 0.0996, "1.23 ± 0.10"),
        (1.2, 0.0999, "1.20 ± 0.10"),
        (-0.00042, 0.00011, "-0.00042 ± 0.00011"),
        (12345.6, 234.0, "12350 ± 230"),
        (0.0, 0.25, "0.00 ± 0.25"),
        (1.23456e-7, 1.2e-9, "(1.235 ± 0.012)e-07"),
        (3.2e8, 1.1e7, "(3.20 ± 0.11)e+08"),
        (2.0, 0.0, "2 ± 0"),
        (1.23456, None, "1.235"),
        (1.23456, math.nan, "1.235"),
        (123456.7, None, "123457"),
        (0.1, None, "0.1"),  # a noise level that was set, not measured
        (0.98104, None, "0.9810"),
        (1.5e-9, None, "1.500e-09"),
        (0.0, None, "0"),
        (np.float64(0.5), np.float64(0.02), "0.500 ± 0.020"),
        (np.int64(12), None, "12"),
        (1000000, None, "1000000"),
        (None, 0.1, "–"),
        (math.nan, 0.1, "–"),
        (math.inf, None, "∞"),
        (True, None, "yes"),
        (np.bool_(False), None, "no"),
        (-0.0001, 0.012, "0.000 ± 0.012"),
        ("white noise", None, "white noise"),
    ],
)
def test_digits_follow_the_standard_error(value: object, se: float | None, shown: str) -> None:
    assert format_value(value, se) == shown


def test_text_is_aligned() -> None:
    lines = to_text(ROWS, {"plant": "plant", "rho": "rho", "n": "runs"}).splitlines()
    assert lines == [
        "plant                 rho  runs",
        "----------  -------------  ----",
        "hair_dryer  1.235 ± 0.012   100",
        "a|b & 100%              –     7",
    ]


def test_all_columns_without_the_standard_errors_by_default() -> None:
    head = to_text(ROWS).splitlines()[0].split()
    assert head == ["plant", "rho", "n", "holds", "c_efficiency"]
    assert to_text([{"x_se": 1.0}]).split()[0] == "x_se"


def test_markdown() -> None:
    assert to_markdown(ROWS, ["plant", "rho", "holds"]).splitlines() == [
        "| plant | rho | holds |",
        "| --- | ---: | --- |",
        r"| hair\_dryer | 1.235 ± 0.012 | yes |",
        r"| a\|b & 100% | – | no |",
    ]


def test_latex() -> None:
    table = to_latex(
        ROWS, {"plant": "plant", "rho": "rho_hat"}, caption="Efficiencies $\\rho$", label="tab:rho"
    )
    assert table.splitlines() == [
        r"\begin{table}",
        r"\centering",
        r"\caption{Efficiencies $\rho$}",
        r"\label{tab:rho}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"plant & rho\_hat \\",
        r"\midrule",
        r"hair\_dryer & $1.235 \pm 0.012$ \\",
        r"a\textbar{}b \& 100\% & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\end{table}",
    ]
    assert r"$(1.235 \pm 0.012) \times 10^{-7}$" in to_latex([{"x": 1.23456e-7, "x_se": 1.2e-9}])
    assert escape_latex(r"\a{b}~c^d#$<>") == (
        r"\textbackslash{}a\{b\}\textasciitilde{}c\textasciicircum{}d\#\$\textless{}\textgreater{}"
    )


def test_csv_keeps_every_digit(tmp_path: Path) -> None:
    path = to_csv(ROWS, tmp_path / "rows.csv")
    back = list(csv.DictReader(path.read_text().splitlines()))
    assert list(back[0]) == ["plant", "rho", "rho_se", "n", "holds", "c_efficiency"]
    assert float(back[0]["rho_se"]) == 0.0123
    assert back[1]["rho"] == ""
    assert back[1]["plant"] == "a|b & 100%"
    exact = [{"x": np.float64(1) / 3, "y": np.int32(4)}]
    assert to_csv(exact, tmp_path / "x.csv").read_text() == f"x,y\n{1 / 3!r},4\n"


def test_parquet_there_and_back(tmp_path: Path) -> None:
    rows = [*ROWS, {"plant": "x", "rho": np.float64(2) / 3, "extra": np.array([1.0, 2.0])}]
    path = to_parquet(rows, tmp_path / "rows.parquet", {"seed": 3, "plants": ["a", "b"]})
    back, metadata = from_parquet(path)
    assert metadata == {"seed": 3, "plants": ["a", "b"]}
    assert back[0] == ROWS[0] | {"extra": None}
    assert back[1]["rho"] is None
    assert math.isnan(back[1]["c_efficiency"])
    assert back[2]["rho"] == 2 / 3
    assert back[2]["extra"] == [1.0, 2.0]
    assert back[2]["n"] is None


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no rows to write"):
        to_csv([], tmp_path / "a.csv")
    with pytest.raises(InputError, match="no row has the columns sigma; the rows have c_efficiency, holds"):
        to_text(ROWS, ["plant", "sigma"])
    with pytest.raises(InputError, match="the column x cannot be stored .*one type"):
        to_parquet([{"x": 1.0}, {"x": "one"}], tmp_path / "a.parquet")
    path = to_csv(ROWS, tmp_path / "b.csv")
    with pytest.raises(InputError, match="exists and is not overwritten"):
        to_csv(ROWS, path)
    to_csv(ROWS[:1], path, overwrite=True)
    assert len(path.read_text().splitlines()) == 2
    with pytest.raises(InputError, match="cannot be read"):
        from_parquet(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.csv"]


def test_an_estimate_below_its_own_standard_error_is_a_run_that_failed():
    """The second run says itself that it knows nothing; the third states no error, the fourth ran out of time."""
    table = pa.table({
        **{name: [0.0, 1.0, 2.0, 3.0] for name in ("replicate", "experiments", "samples", "energy", "peak_amplitude")},
        "estimate": [2.0, 8000.0, 2.1, 2.2], "standard_error": [0.1, 1e8, np.nan, 0.1], "estimator": ["pem"] * 4,
        "status": ["CONVERGED", "CONVERGED", "OK", "TIME_LIMIT"], "message": [""] * 4, "final": [True] * 4,
        "information": [None] * 4, "plant": ["p"] * 4, "method": ["white"] * 4,
    })  # fmt: skip
    found = runs_of(("p", 1.0, "white"), [table]).final["pem"]
    assert found.good.tolist() == [True, False, True, False]
    assert found.statuses == {"CONVERGED": 1, "OK": 1, "SINGULAR": 1, "TIME_LIMIT": 1}
