"""Two tanks in series with square-root outflow and overflow: the model of levels that are no deviations."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.path import OUTFLOW
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.structure import Part, Structure

Array = NDArray[Any]


def tanks(channel: Channel, base: Fit) -> Fit | None:
    """Fit two tanks with square-root outflow, without and with an overflow of the upper one."""
    u, y = channel.u[:, base.structure.inputs[0]], channel.y
    mean = float(np.mean(y[channel.keep]))
    if base.structure.layout != "tf" or len(base.structure.inputs) != 1 or len(y) > 20000:
        return None
    if np.min(y[channel.keep]) < 0 or np.mean(u) <= 0:
        return None
    poles = np.abs(np.roots(np.concatenate(([1.0], base.p[: base.structure.order]))))
    rate = float(np.clip(-np.log(np.clip(poles.max(), 0.2, 0.998)), 1e-3, 1.0)) * 2.0
    k = np.log(rate * np.sqrt(mean))
    s = Structure(2, base.structure.inputs, layout="tanks").adding(Part(OUTFLOW))
    top = float(np.max(y))
    if np.sum(y == top) >= 3:  # the sensor's end stop
        s = s.adding(Part(named("output_clip_upper")))
    scales = np.concatenate((np.ones(8), [mean, mean], np.ones(s.size - 10) * top))
    scales[5], scales[7] = mean, mean
    found: list[Fit] = []
    for share in (0.3, 1.0, 3.0):
        p = np.array(
            [
                k + np.log(share * np.sqrt(mean) / np.mean(u)),
                0.0,
                k + np.log(share),
                k,
                k,
                1e9,
                0.3,
                0.0,
                mean,
                y[0],
            ]
        )
        plain = fit(
            channel, s, np.concatenate((p, [top] * (s.size - 10))), scales, iterations=40, colour=False
        )
        found.append(plain)
    plain = min(found, key=lambda f: f.deviance)
    if np.sum(plain.residual**2) < np.sum(base.residual**2):  # else these are no tanks
        from estimators.diagnosis.effects.kernels.recursion_kernels import tank_levels

        q = plain.p
        with np.errstate(over="ignore"):  # a rate beyond every number is a tank that empties at once
            flow = np.array([np.exp(q[0]), q[1], np.exp(q[2]), np.exp(q[3]), np.exp(q[4]), 1e9, 0.0])
        highest = float(tank_levels(np.ascontiguousarray(u), flow, np.abs(q[8:10]), 4)[:, 0].max())
        for fraction in (0.95, 0.8, 0.65):
            for spilt in (0.1, 0.5):
                p = q.copy()
                p[5:7] = fraction * highest, spilt
                found.append(fit(channel, s, p, scales, iterations=60, colour=False))
    found = [f for f in found if np.isfinite(f.deviance)]
    if not found:
        return None
    best = min(found, key=lambda f: f.deviance)
    return fit(channel, best.structure, best.p, scales, iterations=60)
