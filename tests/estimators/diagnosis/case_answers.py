"""Answers with named effects, one or more of every slot, which simulation and CasADi twin are held to each other on."""

from __future__ import annotations

import numpy as np

from estimators.diagnosis.baseline.linear_model import Prior
from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.model.structure import Part, Structure
from estimators.diagnosis.result.answers import NamedAnswer
from estimators.diagnosis.search.free_runs import Start

__all__ = ["NAMED", "POLES", "PRIOR", "named_answer"]

PRIOR = Prior(0.0, 0.9 ** np.arange(64.0), 0.01)
POLES = {"tf": [-1.5, 0.7, 0.1, 0.1], "first": [-1.0, 0.8], "oscillator": [-2.4, -2.8, 1.0, 0.1],
         "cascade": [-1.0, -0.5, 1.0, 0.2], "driven": [-2.4, -2.8, -0.7, 1.0, 0.2, 0.1], "integrator": [-2.0, 0.3, 0.0]}  # fmt: skip
ORDERS = {"tf": 2, "first": 1, "oscillator": 2, "cascade": 2, "driven": 3, "integrator": 2}

# by name: layout, effects with their parameters (a number of terms or the poles of a block after them), options of the answer
NAMED = {
    "maps": ("tf", [("input_exponential", [0.3]), ("output_tanh", [0.2]), ("offset", [0.4])], {}),
    "limits without delay": ("tf", [("saturation", [0.8]), ("output_clip_upper", [0.5])], {"ahead": True}),
    "late": ("tf", [("delay", [2.4])], {"delay": 3}),
    "play": ("tf", [("backlash_input", [0.4, -0.5]), ("backlash_sampled", [0.1])], {}),
    "rate": ("tf", [("rate_limit", [0.5]), ("lag", [0.6])], {"rest": False}),
    "motor": ("tf", [("three_point", [0.3, 0.2, 0.1, 0.15])], {"rest": False}),
    "a cooler": ("tf", [("acts_beyond", [0.1, -0.5, 1.0, 0.2])], {"rest": False}),
    "a burner": ("tf", [("switched_late", [1.3])], {"rest": False}),
    "its fan": ("tf", [("switched_late", [-2.0])], {"rest": False}),
    "a compressor": ("tf", [("least_pause", [4.4])], {"rest": False}),
    "a heat pump": ("tf", [("least_run", [3.7])], {"rest": False}),
    "a defrost": ("tf", [("event_replaces", [0.3, 2.2, 3.6, -0.7, 0.8])], {"rest": False}),
    "a siphon": ("tf", [("event_adds", [-0.2, 3.1, 2.3, 0.9, 0.0])], {"rest": False}),
    "two rates": ("tf", [("rate_limit_servo", [0.5, 0.2, 0.7])], {"rest": False}),
    "wind up": ("tf", [("wind_up", [0.1, 3.0, 0.3, -0.8, 0.9])], {"rest": False}),
    "thermostat": ("tf", [("relay_feedback", [0.1, 0.2, -0.7, -0.3, 0.4])], {"rest": False}),
    "loop of limited speed": ("tf", [("rate_in_loop", [0.1, 3.0, 0.3, 0.2, 0.3, 0.7, 1.2])], {"rest": False}),
    "its actuator": ("tf", [("rate_of_loop", [0.1, 3.0, 0.3, 0.2, 0.3, 0.7, 0.0])], {"rest": False}),
    "a course": ("tf", [("rate_in_course", [0.1, 3.0, 0.3, 0.02, 0.03, 0.7, 1.2])], {"rest": False}),
    "slow reading": ("tf", [("sensor_rate", [0.1, 0.15, 0.7])], {"rest": False}),
    "a joint": ("tf", [("geared_servo", [0.25, 0.35, 0.4, 0.5, 0.2, 0.05, 0.35])], {"rest": False}),
    "a driveline": ("tf", [("geared_load", [0.05, 0.4, 0.5, 0.2, 0.05, 0.35])], {"rest": False}),
    "its motor": ("tf", [("geared_motor", [0.05, 0.4, 0.5, 0.2, 0.05, 0.35])], {"rest": False}),
    "a queue": ("tf", [("store", [0.02, 0.1, 1.5, 0.7])], {"rest": False}),
    "a cistern": ("tf", [("store_empty", [0.0, 0.1, 0.7])], {"rest": False}),
    "a brim": ("tf", [("store_full", [0.02, 0.1, -0.7])], {"rest": False}),
    "a seat": ("tf", [("strut", [0.3, 0.05, 0.2, 1.5])], {"rest": False}),
    "a patient": ("tf", [("loss_saturating", [0.1, 1.5, 2.0, 0.1, 0.05])], {"rest": False}),
    "a van": ("tf", [("tyre_slip", [0.2, 0.25, 0.8, 1.2, 0.9, 0.7, 1.4, 1.5])], {"rest": False}),
    "a check valve": ("tf", [("flow_up", [0.3, 0.1, 0.02, 0.05, 0.2, -0.1])], {"rest": False}),
    "a converter": ("tf", [("flow_down", [0.3, 0.1, 0.0, 0.05, 0.0, 0.0])], {"rest": False}),
    "angle": ("tf", [("gain_of_angle", [0.3, 0.2, 0.6])], {"rest": False}),
    "angle without delay": ("tf", [("gain_of_angle", [0.3, 0.2, 0.6])], {"ahead": True}),
    "fatigue": ("tf", [("gain_fatigue", [0.02, 0.03])], {"rest": False}),
    "warm": ("tf", [("loss_heat", [0.3, -0.6, 0.5, 0.05])], {"rest": False}),
    "staircase in time": ("tf", [("input_staircase", [0.4, 0.1]), ("gain_periodic", [0.2, 0.3, 0.1])], {}),
    "sampled rate": ("tf", [("rate_limit_sampled", [0.5])], {}),
    "stem": ("tf", [("stiction", [0.5, 0.3, 0.7])], {"ahead": True, "rest": False}),
    "stem that slides": ("tf", [("stiction_sliding", [0.5, 0.3, 0.7])], {"ahead": True, "rest": False}),
    "plays": ("tf", [("plays", [1.2, 0.5, 0.2, 0.1, 0.4, -0.7]), ("plays_output", [0.8, 0.1, 0.3, 0.2, 0.5, 0.3])], {"rest": False}),
    "bends": ("tf", [("hysteresis", [0.6, 0.5])], {}),
    "bends by rate": ("tf", [("hysteresis_rate", [0.6, 2.0])], {}),
    "heat": ("tf", [("gain_heat", [0.1, 30.0])], {"rest": False}),
    "lines": ("tf", [("input_lines", [0.5, -0.4, -1.2, 0.7], {"size": 2}), ("output_lines", [-0.3, 0.2])], {}),
    "sandwich": ("tf", [("sandwich", [-0.5, 0.5, 0.2], {"first": 1})], {}),
    "block with zeros": ("tf", [("input_cubic", [-0.4, 0.3, 0.05], {"first": 1, "free": True})], {}),
    "paths": ("tf", [("mode", [0.2, 0.1, -1.2, 0.8], {"size": 2}), ("integral_curve", [0.3, 0.1, 2.0, 0.2, 3.0, 50.0, -9.0, 4.0])], {}),
    "pitch": ("tf", [("output_ripple", [0.7, 0.05, -0.02, 0.3])], {}),
    "titration": ("tf", [("output_arsinh", [1.7, 0.3])], {}),
    "treads": ("tf", [("output_staircase", [0.4, 0.1])], {}),
    "a wrong span": ("tf", [("misread", [0.7, 0.2, 30.0, 70.4])], {"clock": (-3.0, 1.0, 300)}), "a span set anew": ("tf", [("misread_since", [1.3, -0.2, 50.0])], {"clock": (-3.0, 1.0, 300)}),
    "ranges": ("tf", [("output_ranges", [-0.2, 0.7, 0.3])], {}),
    "cycle": ("tf", [("gain_cycle", [23.4, 7.5, -0.5, 0.2])], {"clock": (-3.0, 1.0, 300)}),
    "turns": ("tf", [("multiplexed", [4.0, 1.0, 0.7, 0.2, 0.0, 0.0])], {"clock": (-3.0, 1.0, 300)}),
    "turns of a slow one": ("tf", [("multiplexed", [3.0, 1.0, 0.9, 0.2, 6.0, 0.0])], {"clock": (-3.0, 1.0, 300), "rest": False}),
    "paced": ("tf", [("sensor_paced", [0.3, 0.4, 0.2])], {"rest": False}),
    "levelled": ("tf", [("automatic_gain", [0.8, 0.6, 4.0, 20.0, 0.1])], {"rest": False}),
    "beating sensor": ("tf", [("output_gain_periodic", [0.2, 0.3, 0.1])], {}),
    "recycle": ("tf", [("recycle", [0.5, 6.0, 2.0, 7.3])], {"rest": False}),
    "on a timer": ("tf", [("waveform", [0.2, 0.3, 0.1, 0.2, -0.1], {"size": 2})], {}),
    "run up": ("tf", [("sweep_input", [0.2, 0.001, 0.3, 0.2, 1.5])], {}),
    "scans": ("tf", [("input_scanned", [3.0, 1.0])], {"rest": False}), "own scans": ("tf", [("input_scanned", [3.37, 1.2])], {"rest": False}),
    "sine": ("tf", [("output_sine", [0.9, 0.3]), ("input_sine", [0.8, 0.3])], {}),
    "fired": ("tf", [("phase_angle", [0.8, 0.3])], {"rest": False}), "fired for a voltage": ("tf", [("phase_angle_voltage", [-0.8, 0.3])], {}),
    "worn": ("tf", [("gain_worn", [0.02, 0.6])], {"rest": False}),
    "at times": ("tf", [("reported_in_time", [0.3, 7.0, 2.0, 0.1])], {"rest": False}),
    "out of echo": ("tf", [("held_in_motion", [0.1, 0.5])], {"rest": False}),
    "a peak": ("tf", [("window_extreme", [5.0, -1.0])], {"rest": False}), "peaks anew": ("tf", [("window_begun_anew", [7.0, 3.0, 1.0])], {"clock": (-3.0, 1.0, 300), "rest": False}),
    "on change": ("tf", [("reported_on_change", [0.3, 0.1])], {"rest": False}),
    "store": ("tf", [("integral_curve", [0.3, 0.1, 2.0, 0.2, 3.0, 50.0, -9.0, 0.0])], {"rest": False}),
    "time": ("tf", [("gain_drift", [0.3]), ("drift", [0.1, 0.2]), ("tones", [0.2, 0.3, 0.1]), ("sweep", [0.1, 0.01, 0.2, 0.1])],
             {}),
    "step": ("tf", [("step_input", [0.5, 40.3])], {"clock": (-30.0, 0.5, 300)}),
    "loads": ("tf", [("steps_input", [0.5, 40.3, -0.3, 70.6], {"size": 2})], {"clock": (-30.0, 0.5, 300)}),
    "zeros": ("tf", [("steps_output", [0.5, 40.3, -0.3, 70.6], {"size": 2})], {"clock": (-30.0, 0.5, 300)}),
    "bit": ("tf", [("input_bit", [0.4, 0.1])], {}), "coil": ("tf", [("gain_worn", [0.02, -1.0])], {"rest": False}),
    "power": ("tf", [("power_limited", [0.3, 0.5])], {"rest": False}),
    "cracked": ("tf", [("input_threshold", [-0.2, 0.6])], {}),
    "ridden": ("tf", [("driven_by_power", [0.3, 0.5])], {"rest": False}),
    "accumulator": ("tf", [("check_valve", [0.4, 0.2, -2.0, 1.6])], {"rest": False}),
    "a motor": ("tf", [("pull_out", [0.4, 0.5, 0.1, -1.0, 1.6])], {"rest": False}),
    "belt": ("tf", [("slipping", [0.4, 0.3, 0.1])], {"rest": False}),
    "process": ("tf", [("orifices", [0.3, 1.5, 0.05])], {}),
    "vessel": ("tf", [("vessel", [0.3, 1.0, 0.4])], {"rest": False}),
    "cut-off": ("tf", [("output_cutoff", [0.1, -0.2])], {}),
    "settling": ("tf", [("gain_settles", [0.6, 0.2])], {"clock": (-30.0, 0.5, 300)}),
    "capacity": ("tf", [("capacity_bump", [0.3, 2.0, 0.4, 0.5])], {"rest": False}),
    "cone": ("tf", [("capacity_level", [0.3, -0.2, 0.5])], {"rest": False}),
    "gap": ("tf", [("output_hyperbola", [0.4])], {}),
    "linear inside": ("driven", [], {"delay": 2}),
    "springs": ("oscillator", [("stiffness_cubic", [0.1]), ("drag", [0.2])], {"rest": False}),
    "friction": ("oscillator", [("stribeck", [0.3, 0.2, 0.15]), ("offset", [0.1])], {}),
    "ring spring": ("oscillator", [("coulomb_grip", [0.3])], {"rest": False}),
    "stop": ("oscillator", [("end_stop", [0.5])], {}),
    "hysteretic spring": ("oscillator", [("hysteretic_spring", [0.24, 0.4])], {}),
    "bilinear": ("cascade", [("bilinear_driven", [0.2])], {}),
    "pendulum behind a lag": ("oscillator", [("pendulum", [-0.5, 0.8], {"first": 1})], {}),
    "play behind a servo": ("oscillator", [("clearance_sprung", [-0.9, 0.3, 0.3, 0.2], {"first": 2})], {}),
    "dry axis": ("integrator", [("coulomb_asymmetric", [0.2, 0.1])], {}),
    "tank": ("first", [("input_quadratic", [0.1]), ("bilinear", [0.1])], {}),
}  # fmt: skip


def named_answer(layout, effects, options) -> NamedAnswer:
    """The answer of a layout's usual plant with these effects."""
    s, p = Structure(ORDERS[layout], layout=layout, delay=options.get("delay", 0)), list(POLES[layout])
    for key, q, *form in effects:
        size = len(q) // 2 if key == "output_lines" else 1
        s = s.adding(Part(OFFSET if key == "offset" else named(key), **({"size": size} | (form or [{}])[0])))
        p += q
    start, clock = Start(PRIOR, options.get("rest", True)), options.get("clock", (0.0, 0.5, 120))
    return NamedAnswer(0, s, np.array(p), start, clock, ahead=options.get("ahead", False))
