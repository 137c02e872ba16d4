"""The recursions of hidden loops against the differential equations that they stand for."""

import numpy as np
import pytest

from estimators.diagnosis.effects.kernels.loop_kernels import COURSE, geared, steered_loop


@pytest.mark.parametrize("which", [0, 1, COURSE])
def test_a_steered_loop_is_its_differential_equation(which):
    """Against Euler's steps, two hundred to a sample, which are off by a two hundredth of what moves in one."""
    pace, proportional, integral, up, down, lag, behind = p = np.array([0.1, 3.0, 0.3, 0.04, 0.06, 0.7, 1.2])
    u, course, h = np.repeat([0.5, 2.0, -1.0, 0.5], 40), which == COURSE, 1.0 / 200
    s = z = x = i = 0.0 if course else u[0]
    at, plain = u[0], []
    for value in u:
        for _ in range(200):
            command = integral * (value - at) - proportional * x if course else proportional * (value - x) + i
            s, z, x, i, at = (
                s + h * np.clip((command - s) / lag, -down, up), z + h * (s - z) / behind, x + h * pace * (z - x),
                i + h * integral * (value - x), at + h * x,
            )  # fmt: skip
        plain.append((x, s, at)[which])
    assert np.max(np.abs(steered_loop(u, p, u[0], which) - plain)) < 0.01 * np.ptp(plain)


@pytest.mark.parametrize(("torque", "seen"), [(False, 2), (True, 3), (True, 1)])
def test_a_geared_drive_is_its_differential_equation(torque, seen):
    """Against two thousand Euler's steps to a sample; and what it says changes with half its play as smoothly as a fit takes for granted."""
    own, damping, ratio, gear, contact, friction, half = p = np.array([0.3, 0.2, 0.4, 0.6, 0.2, 0.05, 0.35])
    u, h, x, plain = np.repeat([0.0, 2.0, -1.0, 0.5], 25), 1.0 / 2000, np.zeros(4), []
    for value in u:
        for _ in range(2000):
            a, v, b, w = x
            past = a - b - min(max(a - b, -half), half)
            twisted = gear**2 * past + contact * (v - w) if past else 0.0
            pull = damping * (value - v) if torque else own**2 * (value - a) - damping * v
            x = x + h * np.array([v, pull - ratio * twisted, w, twisted - friction * w])
        plain.append(x[seen])
    run = geared(u, p, 0.0, torque, seen)
    assert np.max(np.abs(run - plain)) < 0.005 * np.ptp(plain)
    slope = lambda d: (geared(u, p + d * np.eye(7)[6], 0.0, torque, seen) - run) / d
    assert np.max(np.abs(slope(1e-6) - slope(1e-3))) < 0.1 * np.max(np.abs(slope(1e-3)))
