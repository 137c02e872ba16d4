"""What a reader of the pages stumbled over: names cut off, lines that are not seen, curves off their place, units left out."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

import oed
from benchmarks.page.charts import LABEL, chart
from benchmarks.page.content import Figure, line
from benchmarks.page.design import write_design
from benchmarks.page.diagnosis import _residuals
from benchmarks.page.skeleton import _whole_options
from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.effects.effect import Clock
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.result.curves import _before, _straight
from oed import Record
from oed.design import solve_design
from oed.plants.named import named_plant


def test_long_names_beside_a_figure_are_broken_into_lines_and_none_is_cut():
    names = [
        "records of the power iterations, taps selected",
        "records of the power iterations, 49 taps",
        "short",
    ]
    figure = Figure("f", "c", "a", [{"x": 1.0, "y": name} for name in names], sideways=True)
    axis = next(layer["encoding"]["y"]["axis"] for layer in chart(figure)["layer"])
    broken = json.loads(axis["labelExpr"].split("[datum.label]")[0])
    assert {" ".join(lines) for lines in broken.values()} == {*names[:2]}
    assert max(len(words) for lines in broken.values() for words in lines) <= LABEL[1]


def test_a_line_of_one_point_is_seen_and_whole_numbers_have_no_halves_between():
    alone, two = (chart(Figure("f", "c", "a", line(x, x, "white"))) for x in ([1], [1.0, 2.0]))
    marks = [{layer["mark"]["type"] for layer in spec["layer"]} for spec in (alone, two)]
    assert marks == [{"line", "point"}, {"line"}]
    steps = [spec["layer"][0]["encoding"]["x"]["axis"].get("tickMinStep")
             for spec in (two, chart(Figure("f", "c", "a", line([1.0, 1.5], [0.0, 1.0], "")))) ]  # fmt: skip
    assert steps == [1, None]


def test_options_of_commands_stay_in_one_piece():
    assert _whole_options("oed design --noise-variance <1>") == (
        "oed design <span class='whole'>--noise-variance</span> &lt;1&gt;"
    )


@pytest.mark.parametrize(
    "amplitude, said",
    [(None, "To do better, allow more of what limits it: input power."),
     (2.0, "To do better, allow a larger amplitude than 2, which limits the input power.")],
)  # fmt: skip
def test_the_limit_is_named_as_it_was_given(amplitude, said, tmp_path):
    plant = named_plant("reference")
    write_design(tmp_path, solve_design(plant, "D"), plant, {}, None, {"amplitude": amplitude})
    content = json.loads((tmp_path / "report.json").read_text())
    assert content["todo"][-1] == said
    given = {} if amplitude is None else {"amplitude": "2.0"}
    assert content["made"] == given | {"version of oed": oed.__version__}


def test_a_sensor_is_drawn_where_the_output_before_it_goes():
    """Its scale is the model's own: the output was taken for it, where a curve with a centre elsewhere is flat."""
    offset, sensor = Part(OFFSET), Part(named("output_sigmoid"))
    structure = Structure(1, parts=(sensor, offset))
    u = np.random.default_rng(0).standard_normal((50, 1))
    p = np.array([-0.5, 4.0, 0.25, 20.0, 1.0])
    clock = Clock(np.arange(50.0), 50)
    fit = SimpleNamespace(structure=structure, p=p, residual=np.zeros(50))
    channel = SimpleNamespace(u=u, clock=clock)
    plain = structure.keeping([False, False])[0]
    np.testing.assert_array_equal(_before(sensor, fit, channel), simulate(plain, p[:2], u, clock))


def test_a_curve_is_compared_with_a_line_of_its_own_size():
    x = np.linspace(-2.0, 2.0, 41)
    np.testing.assert_array_equal(_straight(x, np.clip(x, -1, 1)), [-2.0, 2.0])
    np.testing.assert_allclose(_straight(x, 0.01 * x + 5.0), [4.98, 5.02])


def test_figures_of_the_residual_have_the_units_of_the_record():
    y = np.random.default_rng(0).standard_normal(400)
    record = Record(
        y[:, None],
        y,
        dt=0.1,
        input_names=("u",),
        output_names=("level",),
        input_units=("A",),
        output_units=("V",),
    )
    result = SimpleNamespace(extra={"test": record}, yhat_before=0.5 * record.y, yhat_after=0.9 * record.y)
    against, spectrum = _residuals(result, 0)  # type: ignore[arg-type]
    assert re.fullmatch(r"simulated level \(V\)|velocity of level \(V/s\)|input u \(A\)", against.x)
    assert (against.y, spectrum.y) == ("mean residual (V)", "V per root hertz")
