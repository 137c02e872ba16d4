"""Parameters of effects as they are said to a reader: plain names, the record's units, seconds and Hz."""

import math
import re

from estimators.residual.measures import stated
from oed.data import Record

PLAIN = {
    "c": "curvature c", "c2": "quadratic coefficient c2", "c3": "cubic coefficient c3", "k": "coefficient k",
    "k1": "linear coefficient k1", "k2": "quadratic coefficient k2", "k3": "cubic coefficient k3", "k5": "fifth-power coefficient k5", "d": "coefficient d",
    "beta": "coefficient beta", "weight": "weight of play", "low": "lower limit",
    "high": "upper limit", "up": "rate upwards", "down": "rate downwards", "cosine": "cosine part", "sine": "sine part",
    "slope_": "slope of the curve", "log_speed": "factor of speed", "left": "share of the half width left after a jump",
    "log_damping": "factor of damping", "log_loss": "factor of loss", "per_angle": "radians per integral of the speed",
    "way": "travel that turns it over", "b": "numerator coefficient", "f": "denominator coefficient", "x": "starting state",
    "wear": "resistance per unit that has passed", "power": "power", "gain_worn.power": "power of the resistance that the gain falls with", "use": "use by the input", "change": "relative change", "start": "time of the start",
    "end": "time of the end", "behind": "lag behind the actuator", "plant": "pole of its plant", "input_kink.c": "steepness c at zero", "output_arsinh.c": "sharpness c", "output_arsinh.centre": "where it is steepest, before the curve",
    "output_absolute.c": "half the difference of the gains, c", "outflow_root.k": "outflow coefficient k", "vessel.k": "outflow coefficient k",
    "reported_on_change.start": "reading at the start, off the signal", "reported_in_time.start": "reading at the start, off the signal", "backlash_input.start": "place in the play at the start", "stiction.start": "place in the play at the start", "stiction_sliding.start": "place in the play at the start",
    "plays.start": "place in the plays at the start", "plays_output.start": "place in the plays at the start", "multiplexed.place": "place in the cycle", "multiplexed.lag": "time constant of the one whose turn it is", "multiplexed.later": "how much later it reads",
    "held_in_motion.limit": "rate from which on it is lost", "instant": "instant of the rate, after the middle of a step", "clock_slips.place": "place in the period at the start", "slip": "what it is late by in the end",
    "window": "length of the window", "window_extreme.side": "1: the largest, -1: the smallest", "window_begun_anew.side": "1: the largest, -1: the smallest", "every": "from one beginning to the next", "window_begun_anew.place": "an instant at which it begins",
    "acts_since.centre": "level about which it acts so", "acts_since.state": "state from which it does", "input_staged.size": "what the second stage adds", "band": "way past the middle between two steps", "output_ranges.slope": "excess of the gain above the level", "output_autorange.slope": "excess of the gain of the upper range",
    "selected": "number of the other input", "share.other": "number of the other input", "share.weight": "weight of the other input in the sum", "dose": "what fills the level", "event_replaces.duration": "duration of an event", "event_adds.duration": "duration of an event", "instead": "what it gives meanwhile", "beside": "what comes beside the input meanwhile", "event_replaces.lag": "lag of the actuator", "event_adds.lag": "lag of the actuator",
    "product_of_lags.level": "level that it counts from", "product_of_lags.lag": "lag of the input", "product_of_lags.slope": "slope of the gain at the centre", "product_of_lags.other": "number of the other input", "product_of_lags.centre": "centre of the other input", "product_of_lags.power": "power of the other input (0: an exponential)",
    "loss_by_lag.rate": "rate of the loss at the centre", "loss_by_lag.level": "level that it counts from", "loss_by_lag.lag": "lag of the input", "loss_by_lag.slope": "slope of the loss at the centre", "loss_by_lag.share": "share of the loss that the other input sets", "loss_by_lag.rise": "rise of the other input by what is lost", "loss_by_lag.other": "number of the other input",
    "loss_by_lag.centre": "centre of the other input", "loss_by_lag.power": "power of the other input in the loss (0: an exponential)", "loss_by_lag.drive": "power of the loss in what drives it", "other_lag": "lag of the other input",
    "relay_feedback.low": "lower level", "relay_feedback.high": "upper level", "gain_heat.time": "time constant",
    "check_valve.rate": "rate of filling", "check_valve.loss": "loss over the rate of filling", "check_valve.level": "level that it empties to", "check_valve.lag": "lag of what fills it",
    "pull_out.rate": "rate where nothing slips", "pull_out.width": "slip of most torque", "pull_out.loss": "load's slope over the torque's where nothing slips", "pull_out.level": "level without a load", "pull_out.lag": "lag of what drives it",
    "rise_and_fall.asymmetry": "relative excess of the rate when it rises", "orifices.asymmetry": "relative excess of the rate when it rises",
    "orifices.rate": "rate at twenty times the laminar difference",
    "gain_settles.more": "excess of the gain at the start, over that in the end", "reading": "what it reads there",
    "capacity_bump.more": "capacity at the level, over that elsewhere less 1", "smooth": "difference below which the flow is laminar", "widening": "widening per level", "angle": "radians per unit of position",
    "excess": "excess of the friction at rest", "speed": "Stribeck speed", "push": "what it adds while on", "pace": "rate of the slow state",
    "relay_feedback.share": "share of the level it adds while on", "relay_feedback.rate": "rate of the level", "spring": "stiffness",
    "fill": "filling per flow", "bring": "level that the flow brings", "carry": "share of the level that the flow takes along",
    "up_by_load": "change of the rate upwards per unit of load", "down_by_load": "change of the rate downwards per unit of load",
    "growth": "power of its frequency that its size goes with", "sensor_paced.rate": "rate at the level", "sensor_paced.change": "relative change of the rate per unit of what it reads",
    "sensor_paced.level": "level at which the rate is stated", "rate_loaded.level": "load at which the rates are stated", "load": "number of the input that is the load", "draw": "draw of the other input, over this one's",
    "exchange_fouled.rate": "rate when clean", "exchange_fouled.share": "share of the rate that is the exchange with the input", "exchange_fouled.level": "level of what passes beside it", "exchange_fouled.more": "resistance that comes in the end, over the clean one",
    "tyre_slip.front": "stiffness of the front axle, over mass and speed", "tyre_slip.rear": "stiffness of the rear axle, over mass and speed", "tyre_slip.turn": "how far yaw slips an axle", "tyre_slip.lever": "lever of the rear axle, over the front one's",
    "tyre_slip.gyration": "square of the front lever, over the radius of gyration's", "tyre_slip.slope": "tyres' coefficient B", "tyre_slip.shape": "tyres' coefficient C",
    "acceleration": "acceleration by the whole head", "water_column.loss": "loss of the head", "idle": "flow at which it idles",
    "loss_saturating.limit": "most that the saturating way clears", "loss_saturating.half": "content at which that clears half of it",
    "flow": "number of the input that is the flow", "loss_heat.share": "relative change of the loss when hot", "heat": "warming per squared level",
    "automatic_gain.share": "fall of the gain per size of late", "automatic_gain.power": "power of the gain's fall", "rises": "time constant as the size grows",
    "falls": "time constant as the size shrinks", "automatic_gain.level": "level about which the size counts",
    "gain_heat.share": "relative change of the gain per squared input", "stiffness_heat.share": "relative change of the stiffness per squared input",
    "hysteresis.share": "share that bends off", "recycle.share": "share that comes back", "slower": "time constant that it goes round through", "quicker": "second time constant", "first": "bend at the lower end", "last": "bend at the upper end", "range": "range of the input's integral",
    "leak": "rate that leaks", "full": "full level", "store.level": "input that keeps it", "store_empty.level": "input that keeps it", "store_full.level": "input that keeps it",
    "resistance": "rate at which the flow ends by itself", "least_flow": "flow that it cannot go below", "start_flow": "flow off its rest at the start", "start_level": "level off its rest at the start",
    "store.start": "what is in it at the start", "store_empty.start": "what is in it at the start", "store_full.start": "what is in it at the start",
    "integral_curve.least": "least of the input's integral", "integral_curve.start": "input's integral before the start",
    "first_rate": "steepness at the lower end", "last_rate": "steepness at the upper end", "memory": "time constant",
    "clock_settles.samples": "shift at the end", "lag.pole": "pole in the z-plane", "wrapped.pole": "pole in the z-plane",
    "lost_samples.samples": "number of samples", "stiffness_gap.slope": "stiffness beyond it, over the first", "stiffness_upper.slope": "change of stiffness, over the first",
    "stiffness_lower.slope": "change of stiffness, over the first",
    "clearance_sprung.spring": "stiffness of the load's own spring, over the drive's", "stiffness_heat.time": "time constant", "stiffness_worked.time": "time constant", "damping_worked.time": "time constant", "stiffness_worked.share": "share of the stiffness that is lost in the end", "damping_worked.share": "damping that comes in the end", "half": "mean square of the deflection at which half of it is", "time": "time of the change",
}  # fmt: skip
"""What a parameter is called where its key is a letter or too short to be understood; elsewhere the key has its words."""

ORDINAL = {1: "st", 2: "nd", 3: "rd"}
"""Endings of the first ordinals; more than twenty parameters of a kind there are not."""
TIME = {
    "sample": 1, "1/sample": -1, "u/sample": -1, "y/sample": -1, "rad/sample": -1, "rad/sample^2": -2, "u sample": 1, "1/(u sample)": -1,
    "u/(u/sample)^2": 2, "u/sample^2": -2, "sample/u^2": 1, "sample/record": 1,
}  # fmt: skip
"""Power of the sampling time by which a number in this unit is brought to seconds."""


def named_plainly(parameter: str, alone: bool = False) -> str:
    """The parameter of an effect, `dead_zone.half_width`, as it is said; `alone` without the effect's name."""
    path, _, name = parameter.rpartition(".")
    effect = path.rpartition(".")[2]
    letters = name.rstrip("0123456789")
    digits = name[len(letters) :]
    known = (f"{effect}.{name}", name, *((letters + "_", letters) if digits else ()))
    word = next((key for key in known if key in PLAIN), None)
    said = PLAIN[word] if word else letters.replace("_", " ")
    if " " in name:  # words already: a digit in them is of a channel
        said = name
    elif digits and word not in known[:2]:  # in front: behind the name it would run into the value
        said = f"{digits}{ORDINAL.get(int(digits), 'th')} {said}"
    owners = [] if alone else [owner.replace("_", " ") for owner in reversed(path.split("."))]
    return " of ".join([said, *(owner for owner in owners if owner not in ("", said))])


def in_units(unit: str, record: Record | None) -> str:
    """A unit of a parameter, its u and y replaced by those of the record where its channels have one of each."""
    if record is None:
        return unit
    known = {"u": {*record.input_units}, "y": {*record.output_units}}

    def named(found: re.Match) -> str:
        name = next(iter(known[found[0]])) if len(known[found[0]]) == 1 else ""
        return found[0] if not name else name if found[0] == unit or name.isalnum() else f"({name})"

    return re.sub(r"\b[uy]\b", named, unit)


def in_seconds(value: float, error: float, unit: str, record: Record | None) -> tuple[float, float, str]:
    """A parameter in its record's units, in seconds and Hz where the sampling time is known (1 is taken for not known)."""
    if unit == "log":  # what is fitted as a logarithm is said as the factor that it is
        return math.exp(value), math.exp(value) * error, "(no unit)"
    power = TIME.get(unit, 0)
    if record is not None and record.dt != 1.0 and power:
        factor = record.dt**power / (2 * math.pi if unit.startswith("rad") else 1.0)
        unit = unit.replace("rad/sample", "Hz").replace("Hz^2", "Hz/s").replace("sample", "s")
        value, error = value * factor, error * factor
    said = in_units(unit.removesuffix("/record"), record)
    if unit.endswith("/record"):
        return value, error, "per record" if said == "1" else f"{said} per record"
    return value, error, {"": "(no unit)", "1": "(no unit)", "record": "of the record"}.get(unit, said)


def spoken(value: float, error: float, unit: str, record: Record | None) -> str:
    """A parameter's value, standard error and unit; without an error where it was one of a few that were tried."""
    value, error, unit = in_seconds(value, error, unit, record)
    if error == 0.0:
        return f"{value:.4g} {unit} (chosen, not fitted)"
    return f"{stated(value, error)} {unit}"
