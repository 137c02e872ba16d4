"""The catalogue: every effect that a linear model can lack, as data plus the function that applies it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects import static

__all__ = ["CATALOGUE", "NATURES", "Clock", "Effect", "effect"]

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Clock:
    """The common clock of two experiments, in samples since the first training sample.

    Attributes
    ----------
    k : ndarray
        (N,) sample numbers on the common clock.
    length : int
        Samples of the training record: ramps are per training record.
    """

    k: Array
    length: int

    @property
    def turn(self) -> Array:
        """Time in training records, (N,)."""
        return self.k / self.length


@dataclass(frozen=True, eq=False)
class Effect:
    """One effect that can be added to any linear model.

    Attributes
    ----------
    key : str
        Name of the variant, unique in the catalogue.
    label : str
        The cause, a word of the vocabulary of `oed diagnose`.
    nature : str
        The kind of cause, where the cause itself is in doubt.
    slot : str
        Where it acts: input, plant, path, output, added, start or noise.
    parameters : tuple of str
        Names of its parameters.
    units : tuple of str
        Unit of each: u, y, 1, sample, and products of these.
    trials : float
        About how many independent shapes a search over its shape parameters tries; the significance of
        its likelihood ratio is corrected by it. Times the record length where `per_sample`.
    sentence : str
        What it does, for the report.
    apply : callable or None
        (signal, parameters, clock) -> signal; None where the plant's recursion holds it.
    per_sample : bool
        Whether `trials` is a fraction of the number of samples.
    """

    key: str
    label: str
    nature: str
    slot: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    trials: float
    sentence: str
    apply: Callable[[Array, Array, Clock], Array] | None = None
    per_sample: bool = False

    def tries(self, n: int) -> float:
        """Independent shapes that the search tries on a record.

        Parameters
        ----------
        n : int
            Samples of the record.

        Returns
        -------
        float
            At least 1.
        """
        return max(1.0, self.trials * (n if self.per_sample else 1.0))


def _drift(y: Array, p: Array, clock: Clock) -> Array:
    return y + p[0] + p[1] * clock.turn


def _tones(y: Array, p: Array, clock: Clock) -> Array:
    total = np.zeros(len(clock.k))
    for w, a, b in p.reshape(-1, 3):
        total += a * np.cos(w * clock.k) + b * np.sin(w * clock.k)
    return y + total


def _recursive(name: str) -> Callable[[Array, Array, Clock], Array]:
    def apply(x: Array, p: Array, clock: Clock) -> Array:
        from estimators.diagnosis.effects import plant_kernels
        from estimators.diagnosis.effects import recursion_kernels as kernels

        if name == "rate":
            return kernels.rate_limited_mean(x, abs(p[0]))
        if name == "rate_sampled":
            return kernels.rate_limited(np.ascontiguousarray(x), abs(p[0]))
        if name == "play_fine":
            return kernels.play(_upsampled(x, 4), abs(p[0]))[::4]
        if name == "bouc_wen":
            share = float(np.clip(p[0], -2.0, 1.0))
            return (1.0 - share) * x + share * plant_kernels.bouc_wen(np.ascontiguousarray(x), abs(p[1]))
        return kernels.play(np.ascontiguousarray(x), abs(p[0]))

    return apply


def _lines(x: Array, p: Array) -> Array:
    """Broken line through the origin."""
    from estimators.diagnosis.effects.recursion_kernels import hinges

    c = np.ascontiguousarray(p)
    return hinges(np.ascontiguousarray(x), c) - hinges(np.zeros(1), c)[0]


def _upsampled(x: Array, by: int) -> Array:
    """Cubic (Catmull-Rom) values between samples: a sensor with play sees the extremes between them."""
    before = np.concatenate((x[:1], x[:-1]))
    after = np.concatenate((x[1:], x[-1:]))
    later = np.concatenate((after[1:], x[-1:]))
    s = np.arange(by) / by
    m0, m1 = (after - before) / 2, (later - x) / 2
    rows = [
        (2 * r**3 - 3 * r**2 + 1) * x
        + (r**3 - 2 * r**2 + r) * m0
        + (3 * r**2 - 2 * r**3) * after
        + (r**3 - r**2) * m1
        for r in s
    ]
    return np.stack(rows, axis=1).ravel()


def _lag(x: Array, p: Array, clock: Clock) -> Array:
    from scipy.signal import lfilter

    pole = np.clip(p[0], -0.999, 0.9999)
    return np.asarray(lfilter([1.0 - pole], [1.0, -pole], x))


def _delay(x: Array, p: Array, clock: Clock) -> Array:
    whole = int(np.floor(p[0]))
    part = p[0] - whole
    shifted = np.concatenate((np.zeros(whole), x[: len(x) - whole])) if whole > 0 else x
    return (1.0 - part) * shifted + part * np.concatenate(([0.0], shifted[:-1]))


NATURES = {
    "input static": "static input nonlinearity",
    "output static": "static output nonlinearity",
    "dynamic": "dynamic nonlinearity",
    "linear": "linear dynamics",
    "time": "time variation",
    "added": "disturbance",
    "noise": "noise",
    "sampling": "sampling",
}

_IN, _OUT, _DYN, _LIN = (
    NATURES["input static"],
    NATURES["output static"],
    NATURES["dynamic"],
    NATURES["linear"],
)
_TIME, _ADD, _NOISE, _SAMPLE = NATURES["time"], NATURES["added"], NATURES["noise"], NATURES["sampling"]

_ENTRIES = (
    # what happens to the input before the plant
    Effect("saturation", "input_saturation", _IN, "input", ("limit",), ("u",), 6,
           "the input is limited to +-limit", lambda x, p, c: static.clip(x, -abs(p[0]), abs(p[0]))),
    Effect("saturation_asymmetric", "input_saturation", _IN, "input", ("low", "high"), ("u", "u"), 15,
           "the input is limited to [low, high]", lambda x, p, c: static.clip(x, min(p), max(p))),
    Effect("saturation_upper", "input_saturation", _IN, "input", ("high",), ("u",), 6,
           "the input is limited from above", lambda x, p, c: np.minimum(x, p[0])),
    Effect("saturation_lower", "input_saturation", _IN, "input", ("low",), ("u",), 6,
           "the input is limited from below", lambda x, p, c: np.maximum(x, p[0])),
    Effect("dead_zone", "input_deadzone", _IN, "input", ("half_width",), ("u",), 6,
           "small inputs do nothing", lambda x, p, c: static.dead_zone(x, -abs(p[0]), abs(p[0]))),
    Effect("dead_zone_asymmetric", "input_deadzone", _IN, "input", ("low", "high"), ("u", "u"), 15,
           "inputs between low and high do nothing", lambda x, p, c: static.dead_zone(x, -abs(p[0]), abs(p[1]))),
    Effect("input_quadratic", "hammerstein", _IN, "input", ("c2",), ("1/u",), 1,
           "the input acts through u + c2 u^2", lambda x, p, c: static.polynomial(x, p[0], 0.0)),
    Effect("input_cubic", "hammerstein", _IN, "input", ("c3",), ("1/u^2",), 1,
           "the input acts through u + c3 u^3", lambda x, p, c: static.polynomial(x, 0.0, p[0])),
    Effect("input_polynomial", "hammerstein", _IN, "input", ("c2", "c3"), ("1/u", "1/u^2"), 1,
           "the input acts through u + c2 u^2 + c3 u^3", lambda x, p, c: static.polynomial(x, p[0], p[1])),
    Effect("input_lines", "hammerstein", _IN, "input", (), (), 30,
           "the input acts through a broken line, a static curve of no simpler form", lambda x, p, c: _lines(x, p)),
    Effect("rate_limit", "rate_limiter", _DYN, "input", ("rate",), ("u/sample",), 6,
           "the actuator cannot move faster than the rate", _recursive("rate")),
    Effect("rate_limit_sampled", "rate_limiter", _DYN, "input", ("rate",), ("u/sample",), 6,
           "the command cannot change faster than the rate from one sample to the next", _recursive("rate_sampled")),
    Effect("backlash_input", "backlash", _DYN, "input", ("half_width",), ("u",), 6,
           "play in the actuator", _recursive("play")),
    Effect("hysteresis", "backlash", _DYN, "input", ("share", "width"), ("1", "u"), 10,
           "the input acts with hysteresis (Bouc-Wen): a share of it bends off and returns on another way",
           _recursive("bouc_wen")),
    Effect("sandwich", "output_nonlinearity", _OUT, "input", (), (), 30,
           "a static nonlinearity stands between two linear blocks (Wiener-Hammerstein)"),
    Effect("gain_drift", "gain_drift", _TIME, "input", ("slope",), ("1/record",), 1,
           "the gain changes slowly: (1 + slope t)", lambda x, p, c: static.ramp_gain(x, c.turn, p[0])),
    Effect("gain_change", "parameter_change", _TIME, "input", ("change", "time"), ("1", "sample"), 0.03,
           "the gain changes abruptly", lambda x, p, c: x * (1.0 + p[0] * static.smooth_step(c.k, p[1], 1.0)), True),
    Effect("step_input", "step_disturbance", _ADD, "input", ("size", "time"), ("u", "sample"), 0.03,
           "a step disturbance enters at the plant input",
           lambda x, p, c: x + p[0] * static.smooth_step(c.k, p[1], 1.0), True),
    Effect("delay", "transport_delay", _LIN, "input", ("delay",), ("sample",), 8,
           "the input acts later than modelled", _delay),
    # inside the plant's recursion: w = force subtracted from the input, in input units
    Effect("stiffness_cubic", "duffing", _DYN, "plant", ("k3",), ("1/u^2",), 2, "a restoring force k3 x^3"),
    Effect("stiffness", "duffing", _DYN, "plant", ("k2", "k3"), ("1/u", "1/u^2"), 2,
           "a restoring force k2 x^2 + k3 x^3"),
    Effect("stiffness_square", "duffing", _DYN, "plant", ("k",), ("1/u",), 4, "a restoring force k |x| x"),
    Effect("stiffness_quintic", "duffing", _DYN, "plant", ("k3", "k5"), ("1/u^2", "1/u^4"), 4,
           "a restoring force k3 x^3 + k5 x^5"),
    Effect("stiffness_gap", "duffing", _DYN, "plant", ("slope", "gap"), ("1", "u"), 15,
           "a second spring beyond a gap on either side"),
    Effect("stiffness_upper", "duffing", _DYN, "plant", ("slope", "corner"), ("1", "u"), 15,
           "another stiffness above a corner: a one-sided spring or an end stop"),
    Effect("stiffness_lower", "duffing", _DYN, "plant", ("slope", "corner"), ("1", "u"), 15,
           "another stiffness below a corner: a one-sided spring or an end stop"),
    Effect("end_stop", "duffing", _DYN, "plant", ("limit",), ("u",), 10,
           "a stop on either side holds the position, without rebound"),
    Effect("outflow", "square_root_outflow", _DYN, "plant", (), (), 30,
           "the outflow grows with the square root of the level, and the upper tank overflows"),
    Effect("coulomb", "coulomb_friction", _DYN, "plant", ("level",), ("u",), 6, "dry friction of constant level"),
    Effect("coulomb_asymmetric", "coulomb_friction", _DYN, "plant", ("level", "asymmetry"), ("u", "1"), 10,
           "dry friction, another level for each direction"),
    Effect("stribeck", "stribeck_friction", _DYN, "plant", ("level", "excess", "speed"), ("u", "u", "u/sample"), 15,
           "dry friction that is larger at low speed"),
    Effect("drag", "nonlinear_drag", _DYN, "plant", ("drag",), ("u/(u/sample)^2",), 2, "quadratic drag c |v| v"),
    Effect("position_damping", "nonlinear_drag", _DYN, "plant", ("d",), ("sample/u^2",), 6,
           "a damping d x^2 v that depends on the position"),
    Effect("hysteretic_spring", "backlash", _DYN, "plant", ("level", "width"), ("u", "u"), 15,
           "a hysteretic restoring force inside the plant (Bouc-Wen), which saturates at the level"),
    Effect("bilinear", "bilinear", _DYN, "plant", ("beta",), ("1/u",), 2, "the input multiplies the state"),
    Effect("bilinear_driven", "bilinear", _DYN, "plant", ("beta",), ("1/u",), 2,
           "the input, after a lag of its own, multiplies the state"),
    Effect("timescale_change", "parameter_change", _TIME, "plant", ("log_speed", "time"), ("1", "sample"), 0.03,
           "the natural frequency or time constants change abruptly", None, True),
    Effect("damping_change", "parameter_change", _TIME, "plant", ("log_damping", "time"), ("1", "sample"), 0.03,
           "the damping changes abruptly", None, True),
    Effect("pole_change", "parameter_change", _TIME, "plant", ("log_speed", "time"), ("1", "sample"), 0.03,
           "one time constant changes abruptly", None, True),
    # parallel paths
    Effect("mode", "missing_mode", _LIN, "path", ("b1", "b2", "f1", "f2"), ("y/u", "y/u", "1", "1"), 20,
           "a second-order mode in parallel with the model"),
    Effect("cross", "mimo_cross", _LIN, "path", ("b1", "b2", "f1", "f2"), ("y/u", "y/u", "1", "1"), 5,
           "another input acts on this output"),
    Effect("delay_order", "transport_delay", _LIN, "order", (), (), 3,
           "the input acts at least two samples later than modelled, through one order more"),
    Effect("order_one", "sensor_lag", _LIN, "order", (), (), 3, "the linear part needs one more order"),
    Effect("order", "missing_mode", _LIN, "order", (), (), 3, "the linear part needs a higher order"),
    # what happens to the output
    Effect("lag", "sensor_lag", _LIN, "output", ("pole",), ("1",), 3, "one more first-order lag", _lag),
    Effect("output_quadratic", "output_nonlinearity", _OUT, "output", ("c2",), ("1/y",), 1,
           "the sensor reads y + c2 y^2", lambda x, p, c: static.polynomial(x, p[0], 0.0)),
    Effect("output_cubic", "output_nonlinearity", _OUT, "output", ("c3",), ("1/y^2",), 1,
           "the sensor reads y + c3 y^3", lambda x, p, c: static.polynomial(x, 0.0, p[0])),
    Effect("output_polynomial", "output_nonlinearity", _OUT, "output", ("c2", "c3"), ("1/y", "1/y^2"), 1,
           "the sensor reads y + c2 y^2 + c3 y^3", lambda x, p, c: static.polynomial(x, p[0], p[1])),
    Effect("output_lines", "output_nonlinearity", _OUT, "output", (), (), 30,
           "the sensor's curve is a broken line, of no simpler form", lambda x, p, c: _lines(x, p)),
    Effect("output_arctan", "output_nonlinearity", _OUT, "output", ("c",), ("1/y",), 2,
           "the sensor reads atan(c y)/c", lambda x, p, c: static.arctangent(x, p[0])),
    Effect("output_tanh", "output_nonlinearity", _OUT, "output", ("c",), ("1/y",), 2,
           "the sensor reads tanh(c y)/c", lambda x, p, c: static.hyperbolic(x, p[0])),
    Effect("output_clip", "output_nonlinearity", _OUT, "output", ("limit",), ("y",), 6,
           "the sensor saturates at +-limit", lambda x, p, c: static.clip(x, -abs(p[0]), abs(p[0]))),
    Effect("output_clip_upper", "output_nonlinearity", _OUT, "output", ("high",), ("y",), 6,
           "the sensor saturates above", lambda x, p, c: np.minimum(x, p[0])),
    Effect("output_clip_lower", "output_nonlinearity", _OUT, "output", ("low",), ("y",), 6,
           "the sensor saturates below", lambda x, p, c: np.maximum(x, p[0])),
    Effect("output_dead_zone", "output_nonlinearity", _OUT, "output", ("half_width",), ("y",), 6,
           "the sensor does not see small outputs", lambda x, p, c: static.dead_zone(x, -abs(p[0]), abs(p[0]))),
    Effect("output_absolute", "output_nonlinearity", _OUT, "output", ("c",), ("1",), 1,
           "the sensor has another gain for each sign", lambda x, p, c: static.absolute(x, p[0])),
    Effect("backlash_output", "backlash", _DYN, "output", ("half_width",), ("y",), 6,
           "play at the output", _recursive("play_fine")),
    Effect("backlash_sampled", "backlash", _DYN, "output", ("half_width",), ("y",), 6,
           "play at the output that moves with the samples, not between them", _recursive("play")),
    # added to the output
    Effect("offset", "output_offset", _ADD, "added", ("offset",), ("y",), 1,
           "a constant is added", lambda y, p, c: y + p[0]),
    Effect("drift", "output_drift", _ADD, "added", ("offset", "slope"), ("y", "y/record"), 1,
           "a trend is added", _drift),
    Effect("step_output", "step_disturbance", _ADD, "added", ("size", "time"), ("y", "sample"), 0.03,
           "a step is added to the output",
           lambda y, p, c: y + p[0] * static.smooth_step(c.k, p[1], 1.0), True),
    Effect("tones", "periodic_disturbance", _ADD, "added", ("frequency", "cosine", "sine"),
           ("rad/sample", "y", "y"), 1.0, "a sinusoid is added", _tones, True),
    Effect("initial", "initial_condition", _LIN, "start", ("c0", "c1", "c2", "c3"), ("y",) * 4, 1,
           "the record does not start at rest"),
    # the noise and the measurement
    Effect("coloured", "coloured_noise", _NOISE, "noise", (), (), 3, "the noise is correlated in time"),
    Effect("feedback", "closed_loop", _NOISE, "noise", (), (), 1, "the input follows the noise: feedback"),
    Effect("outliers", "outliers", _NOISE, "noise", (), (), 1, "single samples are far off"),
    Effect("quantised", "quantisation", _SAMPLE, "noise", ("step",), ("y",), 1, "the output is rounded"),
    Effect("held", "dropouts", _SAMPLE, "noise", (), (), 1, "samples are lost and the last one is repeated"),
)  # fmt: skip

CATALOGUE: dict[str, Effect] = {e.key: e for e in _ENTRIES}


def effect(key: str) -> Effect:
    """The catalogue's entry of a key.

    Parameters
    ----------
    key : str
        For example "saturation" or "coulomb".

    Returns
    -------
    Effect
        The entry.
    """
    return CATALOGUE[key]
