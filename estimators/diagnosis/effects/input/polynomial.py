"""A polynomial of an input, with a start from its powers as inputs of their own: where it falls again, the linear model says nothing of it."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.input.acting import static

Array = NDArray[Any]
MOST = 1e6  # times the curve's linear part at zero, that the rest of it may be


def _coefficients(curve: Array, mean: float, size: float) -> Array:
    """What multiplies x, x^2 and x^3 in a1 x + a2 z^2 + a3 z^3, z = (x - mean)/size."""
    a1, a2, a3 = curve / np.array([1.0, size**2, size**3])
    return np.array([a1 - 2.0 * a2 * mean + 3.0 * a3 * mean**2, a2 - 3.0 * a3 * mean, a3])


def _by_powers(channel: Any, base: Any, j: int) -> Any:
    """The curve and the poles from a linear fit in which its square and its cube come beside an input: of all their numerators, the part
    that is one numerator times a curve."""
    from estimators.diagnosis.model.linear import fit_linear, relinearised
    from estimators.diagnosis.model.structure import Part
    from estimators.diagnosis.record.measurement import switched
    from estimators.diagnosis.search.starts import Start

    s, x, m = base.structure, channel.u[:, j], len(base.structure.inputs)
    if s.layout != "tf" or s.effects or s.order < 1 or switched(x[channel.keep]):
        return None
    mean, size = float(np.mean(x[channel.keep])), float(np.std(x[channel.keep]))
    z = (x - mean) / size
    U = np.column_stack((channel.u[:, list(s.inputs)], z**2, z**3))
    poles = [base.p[: s.order]]
    f = fit_linear(replace(channel, u=U), replace(s, inputs=tuple(range(m + 2))), extra=poles, rough=True)
    end = s.order + (m + 2) * s.taps
    rows = f.p[s.order : end].reshape(m + 2, s.taps)
    at = s.inputs.index(j)
    left, _, taps = np.linalg.svd(
        rows[[at, m, m + 1]] * np.array([[size], [1.0], [1.0]]), full_matrices=False
    )
    first, second, third = _coefficients(left[:, 0] / np.array([size, 1.0, 1.0]), mean, size)
    if not max(abs(second) * size, abs(third) * size**2) < MOST * abs(first):
        return None
    rows[at] = first * taps[0]
    new = s.adding(Part(POLYNOMIAL, j))
    p = np.concatenate((f.p[: s.order], rows[:m].ravel(), f.p[end:], [second / first, third / first]))
    q = relinearised(channel, new, p)
    scales = np.concatenate((base.scales, [1.0 / size, 1.0 / size**2]))
    return None if q is None else Start(new, q, scales, 0.0)


POLYNOMIAL = static(
    "input_polynomial", "hammerstein", "the input acts through u + c2 u^2 + c3 u^3",
    parameters={"c2": "1/u", "c3": "1/u^2"}, apply=lambda x, p, c: x * (1.0 + x * (p[0] + p[1] * x)), more=_by_powers,
    starts=lambda s: ([[a / s.su, b / s.su**2] for a in (-0.1, 0.1) for b in (-0.03, 0.03)], [1 / s.su, 1 / s.su**2]),
)  # fmt: skip
