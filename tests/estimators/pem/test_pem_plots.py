"""The figures are made, and show what they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators.pem import identify, plots
from estimators.residual.tests import residual_tests
from oed.data import Record
from oed.errors import InputError


def test_figures(rng, tmp_path) -> None:
    u = rng.normal(size=(300, 2))
    y = np.column_stack([lfilter([0, 0.2, 0.2], [1, -1, 0.8], u[:, 0]), lfilter([0, 1], [1, -0.5], u[:, 1])])
    record = Record(u, y + 0.1 * rng.normal(size=(300, 2)), dt=0.1, output_units=("m", "V"))
    fit = identify(record, "oe", ([2, 1], [2, 1]), diagonal=True, offset=False)
    compared = plots.plot_compare({"diagonal": fit}, record, window=10)
    assert "diagonal" in compared.axes[0].get_legend().get_texts()[1].get_text()
    assert compared.axes[1].get_ylabel() == "y2 [V]"
    tests = residual_tests(fit, record)
    figures = [
        compared,
        plots.plot_residual_tests(tests),
        plots.plot_bode(fit),
        plots.plot_poles(fit),
        plots.plot_step(fit, 40),
    ]
    assert len(figures[1].axes) == len(tests)
    assert len(figures[2].axes) == 8
    for figure, last in ((figures[2], 3), (figures[4], 3)):
        assert figure.axes[last].get_title() == "u2 to y2"
    for k, figure in enumerate(figures):
        figure.savefig(tmp_path / f"{k}.png", dpi=50)
        assert (tmp_path / f"{k}.png").stat().st_size > 2000


def test_figure_of_a_subspace_method(rng, tmp_path) -> None:
    u = rng.normal(size=300)
    record = Record(u, lfilter([0, 0.2, 0.2], [1, -1, 0.8], u) + 0.1 * rng.normal(size=300))
    for how, panels in (({}, 2), ({"horizon": 6}, 1)):
        fit = identify(record, "ss", (2,), method="moesp", **how)
        figure = plots.plot_order(fit)
        assert len(figure.axes) == panels
        taken, left = figure.axes[0].get_lines()
        assert len(taken.get_xdata()) == 2
        assert len(left.get_xdata()) == fit.subspace.horizon - 2
        figure.savefig(tmp_path / f"{panels}.png", dpi=50)
        assert (tmp_path / f"{panels}.png").stat().st_size > 2000
    with pytest.raises(InputError, match="has no singular values"):
        plots.plot_order(identify(record, "oe", (2, 2), offset=False))
