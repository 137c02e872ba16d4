"""Figures of designs: what is drawn is the design."""

from __future__ import annotations

import numpy as np
import pytest

from oed.design import solve_design
from oed.design.plots import plot_design, plot_sensitivity
from oed.plants.named import named_plant


def test_the_support_lies_on_the_curve_at_one():
    design = solve_design(named_plant("reference"), "D")
    axes = plot_sensitivity(design)
    marks = axes.lines[-1]
    np.testing.assert_allclose(marks.get_xdata(), design.spectrum.omega)
    np.testing.assert_allclose(marks.get_ydata(), 1.0, atol=1e-9)
    curve = axes.lines[1].get_ydata()
    assert np.max(curve) == pytest.approx(1.0, abs=1e-9)
    bars = plot_design(design).collections[-1].get_segments()
    assert [bar[1][1] for bar in bars] == pytest.approx([0.5, 0.5])


def test_a_design_draws_itself():
    figure = solve_design(named_plant("reference"), "D").plot()
    assert len(figure.axes) >= 2
    assert all(axes.lines or axes.collections for axes in figure.axes[:2])
