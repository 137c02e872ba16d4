"""Records of rigs with hidden states that are limited, slow, turn or fill up, or with clocks and losses that change: what is started alike and simulated as in `case_classes`."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from tests.estimators.diagnosis.case_classes import CLASSES, LOOKALIKES
from tests.estimators.diagnosis.case_drives import DRIVES
from tests.estimators.diagnosis.case_parts import FINE, lag, linear, read, sensor, swing
from tests.estimators.diagnosis.case_passages import PASSAGES
from tests.estimators.diagnosis.case_several import SEVERAL

__all__ = ["ALL_CLASSES", "ALL_LOOKALIKES"]


def _loop_of_limited_speed(u, a, actuator):
    """A drive of its own controller, the set point as input, whose valve is no quicker than one rate up and another down."""
    x = s = i = u[0]
    out, h = np.zeros(len(u)), 1.0 / FINE
    for k, value in enumerate(u):
        out[k] = s if actuator else x
        for _ in range(FINE):
            move = (3.0 * (value - x) + i - s) / 0.6
            x, i, s = (
                x + h * 0.1 * (s - x),
                i + h * 0.3 * (value - x),
                s + h * (np.clip(move, -0.2, 0.3) if a else move),
            )
    return out


def slow_valve(u, a):
    return _loop_of_limited_speed(u, a, False)


def slow_valve_seen(u, a):
    return _loop_of_limited_speed(u, a, True)


def steered_ship(u, a):
    """A ship that holds the course asked for: its rudder turns at no more than one rate, and its rate of turn is fed back."""
    at, r, s, out, h = u[0], 0.0, 0.0, np.zeros(len(u)), 1.0 / FINE
    for k, value in enumerate(u):
        out[k] = at
        for _ in range(FINE):
            move = (0.8 * (value - at) - 8.0 * r - s) / 0.6
            at, r, s = (
                at + h * r,
                r + h * 0.08 * (0.5 * s - r),
                s + h * (np.clip(move, -0.03, 0.03) if a else move),
            )
    return out


def compressed(u, a):
    """A microphone behind a cavity, whose amplifier turns down quickly what is loud and up again slowly."""
    y, size, out = linear(u), 0.0, np.empty(len(u))
    for k, value in enumerate(y):
        out[k] = value / (1.0 + 2.0 * a * size) ** 0.7
        more = abs(value) - size
        size += more * (1.0 - np.exp(-1.0 / (8.0 if more > 0.0 else 40.0)))
    return out


def beating(u, a):
    """A bridge whose supply beats with the carrier of its amplifier."""
    return linear(u) * (1.0 + 0.3 * a * np.sin(0.05 * np.arange(len(u)) + 1.0))


def recycled(u, a):
    """Two stirred vessels; half of what leaves the second returns through a long pipe."""
    x, y = np.full(len(u), u[0] / (1.0 - 0.5 * a)), np.full(len(u), u[0] / (1.0 - 0.5 * a))
    for k in range(1, len(u)):
        x[k] = x[k - 1] + 0.3 * (u[k - 1] + 0.5 * a * y[max(k - 25, 0)] - x[k - 1])
        y[k] = y[k - 1] + 0.4 * (x[k - 1] - y[k - 1])
    return y


def on_a_timer(u, a):
    """A second heater that a timer switches on for a fifth of each of its periods."""
    k = np.arange(len(u))[:, None] + np.arange(0.0, 1.0, 0.05)
    return linear(u + 1.5 * a * np.mean((k + 11.0) % 57.3 < 12.0, axis=1))


def rollers(u, a):
    """A pump whose speed lags behind the input; its rollers pinch the hose once in a part of a turn."""
    v, angle, out = u[0], 0.0, np.zeros(len(u))
    for k, value in enumerate(u):
        for _ in range(FINE):
            v += 0.5 / FINE * (value - v)
            angle += 0.12 * v / FINE
            out[k] += v * (1.0 + 0.3 * a * np.sin(angle)) / FINE
    return sensor(out, u[0], 0.6)


def tired(u, a):
    """A muscle: what it gives falls with use and comes back with rest."""
    fresh, out = 1.0 / (1.0 + 2.0 * a * abs(u[0])), np.zeros(len(u))
    for k, value in enumerate(u):
        for _ in range(FINE):
            out[k] += value * fresh / FINE
            fresh += 0.01 / FINE * (1.0 - fresh - 2.0 * a * abs(value) * fresh)
    return linear(out)


def thickened(u, a):
    """A shaft in oil that the friction's power warms; the oil is thinner by its temperature, at any temperature."""
    x, oil, out, rest = u[0], u[0] ** 2, np.zeros(len(u)), 600
    for k, value in enumerate(np.concatenate((np.repeat(u[:1], rest), u)), -rest):
        out[max(k, 0)] = x
        for _ in range(FINE):
            friction = x / (1.0 + a * 0.02 * oil)
            x += 0.15 / FINE * (value - friction)
            oil += 0.01 / FINE * (friction * x - oil)
    return lag(out, 0.4)


def vat(u, a):
    """A heated vat that a cold flow fills; without it, the flow runs off as it comes."""
    heat, flow = u.T
    content, out = 1.0, np.zeros(len(u))
    cold = a * 0.1 * flow[0]
    x = (heat[0] + 0.3 * flow[0] * (1.0 - a) + 0.5 * cold) / (1.0 + cold)
    for k in range(len(u)):
        out[k] = x
        for _ in range(FINE):
            x += (
                0.1
                / FINE
                * (heat[k] - x + 0.3 * flow[k] * (1.0 - a) - a * 0.1 * flow[k] * (x - 0.5))
                / content
            )
            content += a * 0.003 * flow[k] / FINE
    return lag(out, 0.4)


def ageing(u, a):
    """A bed whose activity falls off, heated and fed about levels of their own."""
    fed = 0.6 * u[:, 0] + 0.4 * u[:, 1]
    return sensor(fed, fed[0], 0.7) * np.exp(-0.6 * a * np.arange(len(u)) / len(u))


def belt(u, a):
    """Bulk that a belt of logged speed brings to the scale; without it, the scale stands where it falls."""
    fed = u[:, 0] + 0.1 * u[:, 1]
    k, way = np.arange(len(u), dtype=float), np.cumsum(u[:, 1])
    return np.interp(np.interp(way - 12.0 * a, way, k), k, sensor(fed, fed[0], 0.7))


def gauge(u, a):
    """A gauge that flattens off as a ratio."""
    x = sensor(u, u[0], 0.7)
    return x / (1.0 + 0.5 * a * np.abs(x))


def _plays(x):
    """The mean of three plays, of half widths that grow."""
    out = np.zeros((3, len(x)))
    for row, half in zip(out, np.std(x) * np.array([0.25, 0.5, 1.0]), strict=True):
        stood = x[0]
        for k, v in enumerate(x):
            row[k] = stood = min(max(stood, v - half), v + half)
    return out.mean(axis=0)


def soil(u, a):
    """A retention that dries on another way than it wets."""
    x = sensor(u, u[0], 0.7)
    return 0.4 * x + 0.6 * ((1.0 - a) * x + a * _plays(x))


def ceramic(u, a):
    """An actuator of ceramic, before the mass that it moves."""
    return sensor(0.4 * u + 0.6 * ((1.0 - a) * u + a * _plays(u)), u[0], 0.7)


def tape(u, a):
    """A reading whose time base swings by two samples."""
    k = np.arange(len(u))
    return read(u, np.maximum(k - 2.0 * a * np.cos(0.06 * k + 0.5), 0.0))


def slipping(u, a):
    """A camera whose clock falls behind by three samples in every 71.3, and is then set right."""
    k = np.arange(len(u))
    return read(u, np.maximum(k - 3.0 * a * ((k / 71.3 + 0.3) % 1.0), 0.0))


def vented(u, a):
    """A vent is opened after 310 samples: the losses rise by 40 %, gain and time constant fall; a sensor lags."""
    x = np.empty(len(u))
    x[0] = u[0]
    for k in range(1, len(u)):
        loss = 0.08 * (1.0 + 0.4 * a * (k > 310))
        x[k] = x[k - 1] * np.exp(-loss) + (1.0 - np.exp(-loss)) * 0.08 / loss * u[k - 1]
    return lag(x, 0.6)


def interleaved(u, a):
    k = np.arange(len(u))
    return read(u, k + 0.2 * a * (1 - 2 * (k % 2)))


def swung(u, a):
    """A store that is filled and used by turns, and is never full nor empty at the end."""
    charge = np.concatenate(([0.0], np.cumsum(u)[:-1]))
    charge = (charge - charge.min()) / np.ptp(charge)
    curve = 0.5 * charge + a * (0.3 * np.expm1(-10.0 * charge) + 0.2 * np.exp(15.0 * (charge - 1.0)))
    return curve + 0.05 * lag(np.concatenate((u[:1], u[:-1])), 0.9)


def on_change(u, a):
    """A wireless sensor: it sends a change of more than a fifth of the signal's spread."""
    y = linear(u)
    sent = [y[0] + 0.1 * a * y.std()]
    for now in y:
        sent.append(now if abs(now - sent[-1]) > 0.2 * a * y.std() else sent[-1])
    return np.array(sent[1:])


def cups(u, a):
    """Cups in a duct: they follow the faster, the stronger the wind."""
    wind, y = sensor(u, u[0], 0.6), np.empty(len(u))
    y[0] = wind[0]
    for k in range(1, len(u)):
        y[k] = wind[k] + (y[k - 1] - wind[k]) * np.exp(-0.25 * max(1.0 + 0.3 * a * wind[k], 0.02))
    return y


def beside_a_machine(u, a):
    """A table on springs, beside a machine that is out of balance and runs up through its resonance."""
    k = np.arange(len(u))
    turn = 0.12 * k + 0.5 * 4e-4 * k**2
    pushed = u + a * 0.5 * (1.0 + 4e-4 * k / 0.12) ** 2 * np.cos(turn + 1.0)
    return lfilter([0.0, 0.08], [1.0, -1.85, 0.93], pushed)


def polarised(u, a):
    """A component of an angle that turns by nearly a quarter each way; without it, the angle."""
    x = sensor(u, u[0], 0.7)
    return np.sin(0.9 * a * x - 0.4) / (0.9 * a) if a else x


def cake(u, a):
    """A filter whose cake grows with what has passed: its resistance goes with the root of the pressure's integral."""
    x = np.concatenate((u[:1], u[:-1]))
    return lag(x / np.sqrt(1.0 + 20.0 * a * np.cumsum(np.abs(x)) / np.sum(np.abs(x))), 0.7)


def jack(u, a):
    """A jack that a load slows on its way up and hastens on its way down; without it, one that is always quick enough."""
    x, at, within = np.empty(len(u)), u[0, 0], np.linspace(0.005, 1.0, 200)
    for k, (command, load) in enumerate(u):
        up, down = (max((1.0 + side * 0.3 * load) * 0.3, 0.03) if a else 100.0 for side in (-1.0, 1.0))
        path = at + np.clip(command - at, -down * within, up * within)
        x[k], at = path.mean(), path[-1]
    return lag(np.concatenate((x[:1], x[:-1])), 0.6)


def scanned(u, a):
    """A belt behind a drive that takes its set point over at every fifth sample; without it, at every one."""
    k = np.arange(len(u))
    return lfilter([0.0, 0.12], [1.0, -1.5, 0.62], u[np.maximum(k - (k - 2) % 5, 0)] if a else u)


def staged(u, a):
    """A blower whose second stage comes on above a demand and goes off below a lower one."""
    on, out = False, np.empty(len(u))
    for k, demand in enumerate(u):
        on = demand > 0.6 or (on and demand > -0.4)
        out[k] = demand + 1.5 * a * on
    return linear(out)


def ranged(u, a):
    """A meter that changes its range above a level, where its zero and its gain are others."""
    y = linear(u)
    return y + a * (y > 0.3) * (1.2 + 0.2 * (y - 0.3))


def opened(u, a):
    """Two vessels, each with an inflow, and a valve between them that is opened in the middle of the record."""
    x, out = np.array([u[0, 0], u[0, 1]]), np.empty(len(u))
    for k, flows in enumerate(u):
        out[k] = x[0]
        x = x + 0.04 * (flows - x) + 0.06 * a * (k >= 0.45 * len(u)) * (x[::-1] - x)
    return out


def archived(u, a):
    """A historian that passes on whole steps of a signal, a new one once it is three quarters of a step off the last."""
    y = linear(u)
    if not a:
        return y
    shown, at = np.empty(len(u)), 1.5 * np.round(y[0] / 1.5)
    for k, value in enumerate(y):
        at = 1.5 * np.round(value / 1.5) if abs(value - at) > 1.1 else at
        shown[k] = at
    return shown


def leaking(u, a):
    """A damper that loses its oil, ever more slowly: what is left after the record is a fifth."""
    return swing(
        lambda x, v, f, t: 0.06 * (f - x) - (0.25 if not a else 0.05 + 0.3 * np.exp(-t / 250.0)) * v, u
    )


def polled(u, a):
    """Two probes that one transmitter polls in turn: the second has a lag of twelve samples."""
    y = linear(u)
    return np.where(np.arange(len(u)) % 2 == 0, y, y + a * (lag(y, np.exp(-1.0 / 12.0)) - y))


def slid(u, a):
    """A stem that breaks away and then follows its command at a distance until that halts or turns."""
    stem, way, out, last = 0.0, 0.0, np.empty(len(u)), u[0]
    for k, command in enumerate(u):
        if (command - last) * way <= 0.0:
            way = np.sign(command - stem) if abs(command - stem) > 0.7 * a else 0.0
        if way * (command - stem) > 0.3 * a:
            stem = command - 0.3 * a * way
        out[k], last = stem, command
    return linear(out)


ALL_CLASSES = CLASSES | DRIVES | SEVERAL | PASSAGES | {
    # effect: maker, order of the linear model, form of the input
    "rate_in_loop": (slow_valve, 3, {"hold": 20, "size": 0.5}), "rate_of_loop": (slow_valve_seen, 3, {"hold": 20, "size": 0.5}),
    "gain_of_angle": (rollers, 2, {"mean": 3.0, "size": 0.5}), "gain_fatigue": (tired, 2, {"mean": 2.0}),
    "loss_heat": (thickened, 2, {"mean": 3.0}), "capacity_filled": (vat, 2, {"mean": 2.0, "size": 0.7, "inputs": 2}),
    "gain_decay": (ageing, 2, {"mean": 4.0, "inputs": 2}), "conveyed": (belt, 2, {"mean": 2.0, "size": 0.5, "inputs": 2}),
    "output_ratio": (gauge, 2, {"mean": 4.0, "size": 1.2}), "delay_periodic": (tape, 2, {}), "clock_slips": (slipping, 2, {}),
    "plays": (ceramic, 2, {}), "plays_output": (soil, 2, {}), "loss_change": (vented, 2, {}), "interleaved": (interleaved, 2, {}),
    "reported_on_change": (on_change, 2, {}), "integral_curve of two ways": (swung, 2, {}),
    "sweep_input": (beside_a_machine, 2, {}), "sensor_paced": (cups, 2, {}), "rate_loaded": (jack, 2, {"hold": 15, "inputs": 2}),
    "input_scanned": (scanned, 2, {}), "input_staged": (staged, 2, {}), "output_ranges": (ranged, 2, {}), "output_dead_band": (archived, 2, {}),
    "acts_since": (opened, 1, {"mean": 2.0, "inputs": 2}), "damping_settles": (leaking, 2, {}), "multiplexed of lags": (polled, 2, {}),
    "rate_in_course": (steered_ship, 3, {"hold": 40, "size": 0.5}), "automatic_gain": (compressed, 2, {}), "output_gain_periodic": (beating, 2, {}),

    "recycle": (recycled, 2, {}), "waveform": (on_a_timer, 2, {}), "stiction_sliding": (slid, 2, {"hold": 2}),
}  # fmt: skip

ALL_LOOKALIKES = list(LOOKALIKES.items()) + [
    # effect, a record that looks like it and is not
    ("window_extreme", "rise_and_fall"), ("rise_and_fall", "window_extreme"), ("window_extreme", "sensor_rate"), ("sensor_rate", "window_extreme"), ("window_extreme", "window_begun_anew"), ("window_begun_anew", "window_extreme"), ("window_begun_anew", "refreshed"), ("check_valve", "window_extreme"), ("window_extreme", "check_valve"), ("output_gain_periodic", "window_begun_anew"),
    ("held_in_motion", "reported_on_change"), ("held_in_motion", "sensor_rate"), ("held_in_motion", "refreshed"), ("held_in_motion", "output_dead_band"), ("reported_on_change", "held_in_motion"), ("sensor_rate", "held_in_motion"), ("refreshed", "held_in_motion"), ("lost_samples", "held_in_motion"),
    ("sensor_rate", "rate_in_loop"), ("sensor_rate", "rate_limit_servo"), ("rate_limit_servo", "sensor_rate"), ("sensor_rate", "sensor_paced"), ("rise_and_fall", "sensor_rate"),
    ("geared_servo", "clearance"), ("geared_servo", "stiction"), ("geared_servo", "rate_in_loop"), ("geared_load", "geared_motor"), ("geared_motor", "geared_load"), ("clearance_sprung", "geared_servo"), ("rate_in_loop", "geared_load"), ("geared_load", "stiction"),
    ("store", "wind_up"), ("wind_up", "store"), ("store", "relay_feedback"), ("relay_feedback", "store"), ("store", "rate_limit_servo"), ("rate_limit_servo", "store"), ("store_empty", "store_full"), ("store_full", "store_empty"), ("store_empty", "output_cutoff"), ("store_full", "output_ratio"), ("rate_in_loop", "store"),
    ("outflow_root_fed", "capacity_bump_fed"), ("capacity_bump_fed", "outflow_root_fed"), ("loss_fed", "capacity_bump_fed"), ("reported_in_time", "reported_on_change"), ("reported_on_change", "reported_in_time"), ("reported_in_time", "refreshed"),
    ("reported_in_time", "refreshed of an analyser"), ("reported_in_time", "refreshed"), ("loss_saturating", "rise_and_fall"), ("outflow_root", "loss_saturating"), ("loss_saturating", "capacity_level"), ("loss_cubic", "loss_saturating"), ("loss_saturating", "gain_heat"), ("water_column", "rise_and_fall"), ("flow_up", "water_column"), ("water_column", "loss_cubic"), ("outflow_root", "water_column"), ("bilinear", "water_column"), ("tyre_slip", "input_tanh"), ("saturation", "tyre_slip"), ("tyre_slip", "stiffness_cubic"), ("drag", "tyre_slip"), ("strut", "rise_and_fall"), ("rise_and_fall", "strut"), ("strut", "rate_limit_servo"), ("drag", "strut"),
    ("check_valve", "rise_and_fall"), ("rise_and_fall", "check_valve"), ("check_valve", "orifices"), ("orifices", "check_valve"), ("check_valve", "flow_up"), ("check_valve", "loss_cubic"), ("loss_cubic", "check_valve"), ("check_valve", "outflow_root"), ("outflow_root", "check_valve"), ("check_valve", "capacity_bump"), ("capacity_bump", "check_valve"), ("check_valve", "slipping"), ("slipping", "check_valve"), ("check_valve", "clearance_sprung"), ("check_valve", "pull_out"), ("check_valve", "rate_limit_servo"), ("rate_limit_servo", "check_valve"), ("check_valve", "sensor_rate"), ("sensor_rate", "check_valve"), ("check_valve", "acts_beyond"), ("acts_beyond", "check_valve"),
    ("pull_out", "slipping"), ("slipping", "pull_out"), ("pull_out", "rise_and_fall"), ("rise_and_fall", "pull_out"), ("pull_out", "loss_cubic"), ("loss_cubic", "pull_out"), ("pull_out", "capacity_bump"), ("capacity_bump", "pull_out"), ("pull_out", "rate_limit_servo"), ("rate_limit_servo", "pull_out"), ("pull_out", "outflow_root"), ("outflow_root", "pull_out"), ("pull_out", "power_limited"), ("power_limited", "pull_out"), ("pull_out", "check_valve"), ("pull_out", "loss_saturating"), ("loss_saturating", "pull_out"), ("pull_out", "rate_in_loop"), ("rate_in_loop", "pull_out"),
    ("slipping", "rise_and_fall"), ("slipping", "loss_cubic"), ("rise_and_fall", "slipping"), ("outflow_root", "slipping"), ("store_empty", "flow_up"), ("flow_up", "rise_and_fall"), ("rise_and_fall", "flow_up"), ("flow_up", "wind_up"), ("rate_in_loop", "flow_down"),
    ("flow_down", "output_cutoff"), ("stiction", "flow_up"), ("rate_limit_servo", "flow_up"), ("rate_of_loop", "flow_up"), ("stiction", "stiction_sliding"), ("stiction_sliding", "plays"), ("clearance", "stiction_sliding"),
    ("recycle", "rate_in_loop"), ("recycle", "interleaved"), ("rate_in_loop", "recycle"), ("relay_feedback", "recycle"), ("delay_periodic", "recycle"), ("recycle", "lag_drift"), ("exposure", "through_flow"), ("exposure", "input_power"), ("exposure", "orifices"), ("through_flow", "exposure"), ("input_power", "exposure"),
    ("exposure_carried", "conveyed"), ("exposure_carried", "exposure_walled"), ("exposure_walled", "exposure_carried"), ("exposure_walled", "bilinear"), ("conveyed", "exposure_carried"), ("bilinear", "exposure_walled"),
    ("input_bit", "input_staircase"), ("input_staircase", "input_bit"), ("input_bit", "input_sine"), ("power_limited", "slipping"), ("slipping", "power_limited"), ("saturation_lower", "input_threshold"), ("input_power", "input_threshold"), ("input_exponential", "input_threshold"), ("input_threshold", "magnitude"), ("input_threshold", "input_sine"), ("power_limited", "driven_by_power"), ("driven_by_power", "power_limited"), ("driven_by_power", "loss_cubic"), ("loss_cubic", "driven_by_power"), ("driven_by_power", "capacity_level"), ("capacity_level", "driven_by_power"), ("power_limited", "loss_cubic"), ("power_limited", "store_full"),
    ("gain_worn of a coil", "gain_settles"), ("gain_worn of a coil", "gain_decay"), ("gain_settles", "gain_worn of a coil"), ("gain_cycle", "gain_periodic"), ("gain_cycle", "waveform"), ("waveform", "gain_cycle"), ("gain_cycle", "delay_periodic"), ("gain_of_angle", "gain_cycle"),
    ("waveform", "gain_periodic"), ("gain_periodic", "waveform"), ("waveform", "multiplexed of lags"), ("pulse_input", "waveform"), ("steps_input", "waveform"), ("steps_output", "waveform"),
    ("output_ripple", "position_periodic"), ("position_periodic", "output_ripple"), ("output_ripple", "output_sigmoid"), ("output_ripple", "output_staircase"), ("output_lines", "output_ripple"), ("output_ripple", "plays_output"), ("output_ripple", "stiffness_cubic"),
    ("share", "product_of_inputs"), ("share", "shared_limit"), ("share", "select_low"), ("share", "saturation_upper of two"), ("share", "outflow_root_fed"), ("share", "bilinear"), ("product_of_inputs", "share"), ("product_of_inputs", "share of a burner"),
    ("shared_limit", "share"), ("shared_limit", "share of a burner"), ("select_low", "share"), ("saturation_upper", "share"), ("outflow_root_fed", "share"), ("bilinear", "share"), ("rate_loaded", "share"),
    ("product_of_lags", "product_of_inputs"), ("product_of_inputs", "product_of_lags"), ("product_of_lags", "loss_by_lag"), ("loss_by_lag", "product_of_lags"), ("product_of_lags", "loss_by_lag of an aircraft"), ("product_of_lags", "bilinear"), ("bilinear", "product_of_lags"), ("bilinear", "loss_by_lag"), ("loss_by_lag", "product_of_inputs"), ("product_of_inputs", "loss_by_lag"), ("product_of_lags", "share"), ("loss_by_lag", "share of a burner"), ("share", "product_of_lags"), ("product_of_lags", "select_low"), ("loss_by_lag", "shared_limit"), ("loss_by_lag", "exposure_carried"), ("product_of_lags", "capacity_filled"), ("capacity_filled", "loss_by_lag"), ("product_of_lags", "rate_loaded"), ("loss_by_lag", "conveyed"), ("loss_by_lag", "gain_decay"),
    ("output_arsinh", "output_sigmoid"), ("output_arsinh", "output_exponential"), ("output_arsinh", "output_ratio"), ("output_arsinh", "output_hyperbola"), ("output_arsinh", "output_ripple"), ("output_arsinh", "stiffness_cubic"), ("output_arsinh", "output_autorange"), ("output_arsinh", "automatic_gain"),
    ("output_sigmoid", "output_arsinh"), ("output_logarithm", "output_arsinh"), ("output_ratio", "output_arsinh"), ("output_hyperbola", "output_arsinh"), ("output_sine", "output_arsinh"), ("stiffness_cubic", "output_arsinh"), ("output_ripple", "output_arsinh"), ("automatic_gain", "output_arsinh"),
    ("select_low", "saturation_upper of two"), ("saturation_upper", "select_low"), ("select_low", "shared_limit"), ("shared_limit", "select_low"), ("select_low", "product_of_inputs"), ("product_of_inputs", "select_low"), ("select_high", "select_low"), ("select_low", "select_high"), ("bilinear", "select_high"), ("select_low", "outflow_root_fed"),
    ("shared_limit", "product_of_inputs"), ("product_of_inputs", "shared_limit"), ("shared_limit", "saturation_upper of two"), ("saturation_upper", "shared_limit"), ("shared_limit", "outflow_root_fed"), ("loss_fed", "shared_limit"), ("saturation", "shared_limit of a neighbour"), ("product_of_inputs", "shared_limit of a neighbour"), ("shared_limit", "conveyed"),
    ("coulomb_grip", "plays"), ("coulomb_grip", "hysteresis_rate"), ("coulomb_grip", "stiffness_cubic"), ("hysteresis_rate", "coulomb_grip"), ("three_point", "rate_in_loop"), ("three_point", "geared_servo"), ("rate_limit_servo", "three_point"), ("stiction", "three_point"),
    ("switched_late", "rise_and_fall of a switched heater"), ("least_pause", "rise_and_fall of a switched heater"), ("switched_late", "least_pause"), ("least_pause", "switched_late"), ("least_pause", "least_run"), ("least_run", "least_pause"), ("three_point", "least_pause"), ("rate_limit_servo", "switched_late"), ("stiction", "least_run"),
    ("misread", "steps_output"), ("misread", "steps_input"), ("misread", "output_ranges"), ("misread", "automatic_gain"), ("misread", "gain_decay"), ("misread", "gain_settles"), ("misread", "output_gain_periodic"),
    ("misread_since", "misread"), ("misread_since", "acts_since"), ("misread_since", "gain_decay"), ("misread_since", "gain_settles"), ("misread_since", "steps_output"), ("gain_change", "misread"), ("gain_change", "misread_since"), ("acts_since", "misread"),
    ("pulse_input", "misread"), ("steps_output", "misread"), ("steps_output", "misread_since"), ("output_ranges", "misread"), ("automatic_gain", "misread"), ("steps_input", "gain_periodic"), ("steps_output", "lost_samples"), ("steps_output", "steps_input"), ("output_gain_periodic", "waveform"),
    ("rate_in_course", "rate_in_loop"), ("rate_in_course", "wind_up"), ("rate_in_loop", "rate_in_course"), ("rate_limit_servo", "rate_in_course"), ("automatic_gain", "gain_heat"), ("automatic_gain", "output_ratio"), ("output_ratio", "automatic_gain"), ("gain_heat", "automatic_gain"),
    ("automatic_gain", "input_tanh"), ("automatic_gain", "capacity_level"), ("automatic_gain of a level", "gain_fatigue"), ("input_tanh", "automatic_gain of a level"), ("capacity_level", "automatic_gain of a level"), ("gain_heat", "automatic_gain of a level"),
    ("output_gain_periodic", "gain_periodic"), ("gain_periodic", "output_gain_periodic"), ("output_gain_periodic", "delay_periodic"), ("automatic_gain", "output_gain_periodic"),
    ("interleaved", "multiplexed of lags"), ("interleaved", "multiplexed of instants"), ("damping_settles", "resonance_drift"), ("damping_settles", "gain_settles"), ("damping_settles", "loss_change"),
    ("stiffness_settles", "inertia_settles"), ("inertia_settles", "stiffness_settles"), ("resonance_settles", "damping_settles"), ("stiffness_settles", "gain_settles"),
    ("stiffness_worked", "stiffness_cubic"), ("stiffness_cubic", "stiffness_worked"), ("stiffness_worked", "damping_worked"), ("damping_worked", "stiffness_worked"), ("position_damping", "damping_worked"), ("drag", "damping_worked"),
    ("event_replaces", "waveform"), ("event_adds", "waveform"), ("event_adds", "steps_input"), ("event_adds", "relay_feedback"), ("event_replaces", "relay_feedback"), ("event_replaces", "saturation_upper of two"), ("event_replaces", "gain_decay"), ("event_adds", "least_pause"), ("event_adds", "misread"),
    ("waveform", "event_adds"), ("steps_input", "event_adds"), ("relay_feedback", "event_replaces"), ("gain_periodic", "event_replaces"), ("input_staged", "event_replaces"),
    ("input_tanh", "phase_angle"), ("input_sine", "phase_angle"), ("phase_angle_voltage", "phase_angle"), ("saturation_asymmetric", "phase_angle"), ("phase_angle", "input_sine"), ("phase_angle", "input_kink"),
    ("acts_beyond", "rise_and_fall"), ("rise_and_fall", "acts_beyond"), ("saturation", "acts_beyond"), ("acts_beyond", "rate_limit_servo"), ("input_kink", "acts_beyond"), ("acts_beyond", "bilinear"), ("sensor_paced", "acts_beyond"),
    ("gain_settles", "exchange_fouled"), ("lag_drift", "exchange_fouled"), ("inertia_settles", "exchange_fouled"), ("exchange_fouled", "capacity_level"), ("bilinear", "exchange_fouled"), ("acts_since", "gain_periodic"), ("acts_since", "relay"), ("acts_since", "inertia_drift"), ("acts_since", "capacity_filled"),
    ("input_staged", "plays"), ("relay", "input_staged"), ("output_ranges", "magnitude"), ("output_ranges", "output_cutoff"), ("output_ranges", "output_autorange"), ("input_staged", "output_autorange"), ("output_autorange", "input_staged"), ("output_autorange", "output_cutoff"), ("output_autorange", "plays_output"), ("relay", "output_autorange"),
    ("output_dead_band", "plays_output"), ("output_staircase", "output_dead_band"), ("plays_output", "output_dead_band"), ("input_scanned", "gain_periodic"), ("input_scanned", "delay_periodic"), ("gain_periodic", "input_scanned"), ("refreshed", "input_scanned"),
    ("sweep_input", "gain_periodic"), ("sweep_input", "delay_periodic"), ("sensor_paced", "rise_and_fall"), ("sensor_paced", "output_ratio"), ("rise_and_fall", "sensor_paced"),
    ("rate_loaded", "product_of_inputs"), ("rate_loaded", "capacity_filled"), ("reported_on_change", "refreshed"), ("reported_on_change", "plays_output"), ("rate_in_loop", "wind_up"), ("rate_of_loop", "wind_up"), ("wind_up", "rate_in_loop"), ("rate_limit_servo", "rate_in_loop"),
    ("gain_of_angle", "gain_periodic"), ("gain_periodic", "gain_of_angle"), ("gain_fatigue", "gain_heat"), ("gain_heat", "gain_fatigue"), ("loss_heat", "loss_cubic"), ("loss_cubic", "loss_heat"), ("capacity_filled", "product_of_inputs"), ("bilinear", "capacity_filled"),
    ("gain_decay", "product_of_inputs"), ("conveyed", "product_of_inputs"), ("conveyed", "capacity_filled"), ("output_ratio", "loss_cubic"),
    ("output_ratio", "magnitude"), ("output_hyperbola", "output_sigmoid"), ("output_hyperbola", "output_exponential"), ("capacity_level", "loss_cubic"), ("capacity_level", "orifices"), ("delay_periodic", "gain_periodic"), ("gain_periodic", "delay_periodic"),
    ("plays", "hysteresis_rate"), ("plays", "clearance"), ("plays_output", "plays"), ("plays_output", "input_kink"), ("plays_output", "clearance"),
    ("clock_slips", "delay_periodic"), ("clock_slips", "clock_drift"), ("clock_slips", "lost_samples"), ("delay_periodic", "refreshed"), ("delay_periodic", "clock_drift"), ("stiffness_periodic", "delay_periodic"), ("loss_periodic", "gain_periodic"), ("gain_periodic", "loss_periodic"), ("loss_periodic", "gain_cycle"),
    ("gain_periodic", "gain_heat"), ("clearance_sprung", "stiffness_cubic"), ("clearance_sprung", "hysteresis_rate"), ("lag_drift", "gain_heat"), ("inertia_drift", "lag_drift"), ("lag_drift", "lost_samples"), ("clock_settles", "lag_drift"),
    ("clock_drift", "clock_settles"), ("lost_samples", "clock_settles"), ("loss_change", "inertia_drift"), ("interleaved", "clock_drift"),
]  # fmt: skip
