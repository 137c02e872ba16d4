"""Rigs with a gear that has play, a transmitter that follows at limited rates, stores that run full or empty, flows that cannot turn back:
simulated as in `case_classes`."""

from __future__ import annotations

import numpy as np

from tests.estimators.diagnosis.case_parts import FINE, lag, linear, read, swing, wheel

__all__ = ["DRIVES"]


def _through_a_gear(u, a, seen):
    """A drive that moves a load through an elastic gear with play: a servo where its position is seen (2), else by its torque."""
    x, out, h, servo = np.array([0.0, 0.0, 0.0, 0.0]), np.zeros(len(u)), 1.0 / FINE, seen == 2
    for k, value in enumerate(u):
        out[k] = x[seen]
        for _ in range(FINE):
            twist = x[0] - x[2]
            past = twist - np.clip(twist, -0.35 * a, 0.35 * a)
            torque = 0.25 * past + (0.2 * (x[1] - x[3]) if past else 0.0)
            pull = 0.06 * (value - x[0]) - 0.35 * x[1] if servo else 0.05 * value - 0.05 * x[1]
            speeds = x[[1, 3]] + h * np.array([pull - 0.4 * torque, torque - 0.05 * x[3]])
            x = np.array([x[0] + h * speeds[0], speeds[0], x[2] + h * speeds[1], speeds[1]])
    return out


def joint(u, a):
    return _through_a_gear(u, a, 2)


def driveline(u, a):
    return _through_a_gear(u, a, 3)


def engine(u, a):
    return _through_a_gear(u, a, 1)


def transmitter(u, a):
    """A transmitter whose reading moves at no more than one rate up and another down."""
    x, v, out = linear(u), 0.0, np.zeros(len(u))
    for k in range(1, len(u)):
        for i in range(FINE):
            move = (x[k - 1] + (i + 0.5) / FINE * (x[k] - x[k - 1]) - v) / 1.5
            v += (np.clip(move, -0.12, 0.08) if a else move) / FINE
        out[k] = v
    return out


def _filling(u, a, low, high):
    """A vessel with a small leak that a flow fills from a quarter of the way, its ends in the way or not, read with a lag."""
    x, out = 0.0, np.zeros(len(u))
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            x += (value - 0.1 - 0.01 * x) / FINE
            x = min(max(x, low), high) if a else x
    return lag(out, 0.4)


def buffer(u, a):
    return _filling(u, a, -8.0, 16.0)


def cistern(u, a):
    return _filling(u, a, -6.0, np.inf)


def overflowing(u, a):
    return _filling(u, a, -np.inf, 6.0)


def seat(u, a):
    """A seat on a moved floor, whose damper resists less as the floor comes up."""
    r, x, v, out = u[0], u[0], 0.0, np.zeros(len(u))
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            r += (value - r) / 1.5 / FINE
            gain = (value - r) / 1.5 - v
            v += (0.06 * (r - x) + (0.05 if a and gain > 0.0 else 0.3) * gain) / FINE
            x += v / FINE
    return lag(out, 0.3)


def van(u, a):
    """A van that is steered hard: its tyres hold it sideways the less, the further they slip."""
    side = lambda slip: np.sin(1.3 * np.arctan(1.1 * slip)) / 1.43 if a else slip
    slip = yaw = 0.0
    wheels, out = u[0], np.empty(len(u) + 99)
    for k, wanted in enumerate(np.append(np.full(99, u[0]), u)):
        out[k] = yaw
        for _ in range(FINE):
            front, rear = 0.14 * side(slip + yaw - wheels), 0.18 * side(slip - 0.9 * yaw)
            slip, yaw = slip - (front + rear + 0.7 * yaw) / FINE, yaw + 1.1 * (0.9 * rear - front) / FINE
            wheels += 0.6 * (wanted - wheels) / FINE
    return out[99:]


def turbine(u, a):
    """A turbine at the foot of a pipe, whose water is slow; or one whose power follows its gate."""
    if not a:
        return linear(u)
    gate, flow, out = u[0], u[0] / np.sqrt(1.0 + 0.01 * u[0] ** 2), np.empty(len(u))
    for k, wanted in enumerate(u):
        out[k] = (flow / gate) ** 2 * (flow - 0.4)
        for _ in range(FINE):
            flow += 0.8 * (1.0 - 0.01 * flow**2 - (flow / gate) ** 2) / FINE
            gate += 0.5 * (wanted - gate) / FINE
    return lag(out, 0.3)


def patient(u, a):
    """A drug that is infused, that an enzyme breaks down, and that tissue takes up and gives back."""
    out, blood, tissue = np.empty(len(u)), 0.0, 0.0
    loss = lambda c: 5.0 * c / (2.0 + c) + 0.2 * c if a else 1.2 * c
    for k, infused in enumerate(np.append(np.full(300, u[0]), u)):
        if k >= 300:
            out[k - 300] = blood
        for _ in range(FINE):
            blood, tissue = (
                blood + (0.1 * (infused - loss(blood)) + 0.1 * (tissue - blood)) / FINE,
                tissue + 0.06 * (blood - tissue) / FINE,
            )
    return out


def in_time(u, a):
    """A meter that sends what has changed by more than a step, and what it reads every 23 samples."""
    y = linear(u)
    if not a:
        return y
    sent, last = np.empty(len(u)), y[0]
    for k, value in enumerate(y):
        last = value if abs(value - last) > 1.2 or k % 23 == 4 else last
        sent[k] = last
    return sent


def _fed(u, a, move):
    """A level that two inputs feed, read with a lag; its motion with the effect or without."""
    x, out = u[0, 0] + 0.6 * u[0, 1], np.zeros(len(u))
    for k, (one, other) in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            x += move(one + 0.6 * other, x, a) / FINE
    return lag(out, 0.4)


def basin(u, a):
    return _fed(u, a, lambda f, x, a: 0.1 * (f - (np.sqrt(6.4 * max(x, 0.0)) if a else x)))


def melting(u, a):
    return _fed(u, a, lambda f, x, a: 0.15 * (f - x) / (1.0 + 4.0 * a * np.exp(-(((x - 6.5) / 0.5) ** 2))))


def slipping_belt(u, a):
    """A shaft that a belt drives, by no more than its friction bears."""
    x, out = 0.0, np.zeros(len(u))
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            pull = 0.4 * (value - x)
            x += ((0.15 * np.tanh(pull / 0.15) if a else pull) - 0.04 * x) / FINE
    return lag(out, 0.4)


def accumulator(u, a):
    """What a pump that runs up fills through a valve that lets nothing back, and a consumer empties."""
    s, x, out = 1.4 * u[0], 1.4 * u[0] * 0.4 / 0.46, np.zeros(len(u))
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            flow = s - x
            x += (0.4 * (max(flow, 0.0) if a else flow) - 0.06 * x) / FINE
            s += (1.4 * value - s) / 1.7 / FINE
    return 3.0 + out


def induction(u, a):
    """A motor whose torque falls beyond a slip of .9, on a fan, behind a converter that ramps; or with a torque in proportion to the slip."""
    field, x, out = u[0], u[0] / 1.03, np.zeros(len(u))
    for _ in range(400 * FINE):  # until it runs as it does before the record
        slip = field - x
        x += 0.35 * ((slip / (1.0 + (slip / 0.9) ** 2) if a else slip) - 0.03 * x) / FINE
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            slip = field - x
            x += 0.35 * ((slip / (1.0 + (slip / 0.9) ** 2) if a else slip) - 0.03 * x) / FINE
            field += (value - field) / 4.0 / FINE
    return 30.0 * out


def _one_way(u, a, way):
    """A flow with inertia through a valve that lets it pass one way only, into a vessel that leaks, read with a lag."""
    drive, v = way * u, way * u[0] * 0.3 / 0.314
    flow, out = 0.14 / 3.0 * v, np.zeros(len(u))
    for k, value in enumerate(drive):
        out[k] = way * v
        for _ in range(FINE):
            flow += (0.3 * (value - v) - 0.1 * flow) / FINE
            flow = max(flow, 0.0) if a else flow
            v += (0.3 * flow - 0.014 * v) / FINE
    return lag(out, 0.4)


def rectified(u, a):
    return _one_way(u, a, 1.0)


def drained(u, a):
    return _one_way(u, a, -1.0)


def curing(u, a):
    """A resin that stiffens under a lamp, ever more slowly."""
    return swing(lambda x, v, f, t: 0.06 * (f - (1.0 + 1.2 * a * -np.expm1(-t / 250.0)) * x) - 0.03 * v, u)


def icing(u, a):
    """A beam that ice loads until no more of it sticks."""
    return swing(lambda x, v, f, t: (0.06 * (f - x) - 0.03 * v) / (1.0 - 1.5 * a * np.expm1(-t / 250.0)), u)


def stretching(u, a):
    """A load on a belt that slackens as it runs in: the belt drives it, and holds it."""
    return swing(lambda x, v, f, t: 0.06 * (1.0 + 0.5 * a * np.expm1(-t / 250.0)) * (f - x) - 0.03 * v, u)


def parked(u, a):
    """A wheel that rocks until the drive takes its eccentric over the top."""
    return wheel(u, 0.03, 2.6 * a, 0.12)


def loaded_twice(u, a):
    """A hull that heels as one load comes on board after the other, and rights itself on its spring and damping."""
    k = np.arange(len(u))
    return swing(lambda x, v, f, t: 0.06 * (f - x) - 0.12 * v, u + a * (0.9 * (k > 188) + 0.7 * (k > 430)))


def set_anew(u, a):
    """A sensor that is given another zero, twice, after a lag."""
    k = np.arange(len(u))
    return linear(u) + a * (-0.4 * (k > 240) + 0.25 * (k > 455))


def wrong_span(u, a):
    """A transmitter whose span is set wrongly for a while, with a zero that this moves, and set right again."""
    return np.array([x - a * (0.35 * x + 0.2) if 251 <= k < 433 else x for k, x in enumerate(linear(u))])


def other_range(u, a):
    """A transmitter that is switched to another range, whose gain and zero are not the first one's."""
    return np.array([x + a * (0.25 * x - 0.3) if k >= 362 else x for k, x in enumerate(linear(u))])


def damper(u, a):
    """A flap's motor that starts a quarter of a unit off, runs at one speed and halts a fifteenth before its command."""
    angle, way, out = u[0], 0.0, np.empty(len(u))
    for k, command in enumerate(u):
        total = 0.0
        for _ in range(FINE):
            off = command - angle
            way = np.sign(off) if abs(off) > 0.25 else way if way * off > 0.07 else 0.0
            angle += way * 0.09 / FINE if a else 0.0
            total += angle / FINE if a else command / FINE
        out[k] = total
    return linear(out)


def buffers(u, a):
    """A wagon on ring springs, whose rings rub the harder the farther they are pressed."""
    return swing(lambda x, v, f, t: 0.08 * (f - x - 0.5 * a * abs(x) * np.tanh(v / 0.003)) - 0.03 * v, u)


def _in_its_time(u, late=0.0, pause=0.0, run=0.0):
    """What takes a switched command over late as it rises, and not before it has paused or run for long enough."""
    v, out, since, last, rises = u[0], np.empty(len(u)), 0.0, -np.inf, False
    for k, command in enumerate(u):
        if k and command != u[k - 1]:
            since, rises = k, command > u[k - 1]
        total = 0.0
        for now in k + np.arange(FINE) / FINE:
            if v != command and now >= max(since + late * rises, last + (pause if rises else run)):
                v, last = command, now
            total += v / FINE
        out[k] = total
    return linear(out)


def purged(u, a):
    """A burner that blows its chamber through before it lights."""
    return _in_its_time(u, late=2.6 * a)


def locked_out(u, a):
    """A compressor that is locked against a start until its pressures are even."""
    return _in_its_time(u, pause=8.4 * a)


def kept_running(u, a):
    """A heat pump that runs for some minutes once it has started."""
    return _in_its_time(u, run=8.4 * a)


def out_of_echo(u, a):
    """A level gauge that loses its echo while the level moves fast, and shows the last one."""
    now = np.arange(len(u)) * 1.0
    y = read(u, now)
    speed = FINE * np.abs(y - read(u, np.maximum(now - 1.0 / FINE, 0.0)))
    shown = y.copy()
    for k in range(1, len(u)):
        if a * speed[k] > 0.4:
            shown[k] = shown[k - 1]
    return shown


def screwed(u, a):
    """A table whose scale is wrong by a screw's pitch, over and over."""
    x = linear(u)
    return x + a * (0.13 * np.sin(4.0 * x) + 0.06 * np.cos(4.0 * x))


def neutralised(u, a):
    """The pH of a tank in which a base meets an acid: what is left of either and of the water's own ions balance."""
    excess = linear(u)
    if not a:
        return excess
    left = 3.0 * (excess - 10.2)
    return 7.0 + np.log10(left + np.sqrt(left**2 + 1.0))


def peak_held(u, a):
    """A meter whose needle stays up for a while."""
    x = linear(u)
    late = [np.concatenate((np.repeat(x[:1], k), x[: len(x) - k])) for k in range(1 + int(10 * a))]
    return np.max(late, axis=0)


def demanded(u, a):
    """A meter of the most that was drawn since the quarter of an hour began."""
    x = linear(u)
    return (
        np.concatenate([np.maximum.accumulate(one) for one in np.split(x, range(5, len(x), 12))]) if a else x
    )


DRIVES = {
    # effect: maker, order of the linear model, form of the input
    "reported_in_time": (in_time, 2, {}),
    "window_extreme": (peak_held, 2, {"hold": 15}),
    "window_begun_anew": (demanded, 2, {"hold": 15}),
    "held_in_motion": (out_of_echo, 2, {"hold": 15}),
    "sensor_rate": (transmitter, 3, {}),
    "geared_servo": (joint, 4, {"hold": 15}),
    "geared_load": (driveline, 3, {"hold": 15}),
    "geared_motor": (engine, 3, {"hold": 15}),
    "store": (buffer, 2, {"hold": 15}),
    "store_empty": (cistern, 2, {"hold": 15}),
    "store_full": (overflowing, 2, {"hold": 15}),
    "outflow_root_fed": (basin, 2, {"mean": 4.0, "inputs": 2}),
    "capacity_bump_fed": (melting, 2, {"mean": 4.0, "inputs": 2}),
    "output_ripple": (screwed, 2, {"hold": 10}),
    "output_arsinh": (neutralised, 2, {"mean": 4.0}),
    "strut": (seat, 3, {"hold": 10}), "tyre_slip": (van, 3, {}), "loss_saturating": (patient, 2, {"mean": 3.0, "size": 1.3, "hold": 10}), "water_column": (turbine, 2, {"mean": 4.0, "size": 0.8}),
    "slipping": (slipping_belt, 2, {"hold": 10}),
    "check_valve": (accumulator, 2, {"mean": 4.0, "hold": 10}), "pull_out": (induction, 2, {"mean": 8.0, "size": 1.5, "hold": 20}),
    "flow_up": (rectified, 3, {"hold": 15, "mean": 1.0}),
    "flow_down": (drained, 3, {"hold": 15, "mean": -1.0}),
    "stiffness_settles": (curing, 2, {}), "inertia_settles": (icing, 2, {}), "resonance_settles": (stretching, 2, {}),
    "three_point": (damper, 3, {"hold": 12, "size": 0.7}),
    "coulomb_grip": (buffers, 2, {}),
    "switched_late": (purged, 2, {"two": True}), "least_pause": (locked_out, 2, {"two": True}), "least_run": (kept_running, 2, {"two": True}),
    "steps_input": (loaded_twice, 2, {}), "steps_output": (set_anew, 2, {}),
    "misread": (wrong_span, 2, {}), "misread_since": (other_range, 2, {}),
    "position_periodic of a wheel that was parked": (parked, 2, {"mean": 2.6, "size": 0.5}),
}  # fmt: skip
