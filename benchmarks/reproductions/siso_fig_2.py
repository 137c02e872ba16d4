"""[S] Fig. 2: magnitude of the plant and limit spectra at noise variances 1, 4 and 9 by the matrix H_d."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.tables.reproduced import row
from oed.plants.named import named_plant
from oed.theory.limit import limit_spectrum
from oed.theory.limit_on_grid import limit_spectrum_on_grid


def rows() -> Iterator[dict[str, Any]]:
    """The exact limit spectrum against the paper's discretised one, line by line."""
    for variance, points in ((1.0, 8000), (4.0, 1000), (9.0, 1000)):
        plant = named_plant("reference", variance)
        exact, grid = limit_spectrum(plant), limit_spectrum_on_grid(plant, points)
        on_grid = grid.spectrum.power[:, 0, 0].real * points
        ratio = on_grid / exact.density(grid.spectrum.omega)
        yield row(f"limit spectrum by H_d over that by the factorisation, variance {variance:g}",
                  "[S] Fig. 2 right and H_d of Sec. 5", 1.0, float(ratio[np.argmax(np.abs(ratio - 1))]), 1e-8,
                  f"the worst of {points} lines; the midpoint rule is exact once the lines are closer than the peak is wide "
                  f"(half-width {np.sqrt(2 * exact.mu2_excess / exact.peak.curvature):.2g} rad/sample), which the 1000 lines of the paper are not at variance 1.")  # fmt: skip
