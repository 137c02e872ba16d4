"""Rigs whose input is a flow that is changed on its way, and others whose input is weakened, wound up or coded, or whose sensors read in turn: as in `case_classes`."""

from __future__ import annotations

import numpy as np

from tests.estimators.diagnosis.case_parts import FINE, lag, linear, process, sensor, swing

__all__ = ["PASSAGES"]

REST = 60  # samples before a record, more than twice what a passage takes
PARCELS = 10  # that leave in a sample
TUBE = 14.0  # samples of flow that fill it


def _followed(flow, entering, wall):
    """Each parcel that leaves a tube, some a sample, followed back until it entered: heat from the wall by the power .6 of the flow."""
    before = lambda x: np.repeat(np.concatenate((np.full(REST, x[0]), x)), PARCELS)
    flow, entering, wall = before(flow) / PARCELS, before(entering), before(wall)
    out = np.zeros(len(flow))
    for k in range(REST * PARCELS // 2, len(flow)):
        ahead, i, keeps = TUBE, k, 1.0
        while ahead > 0.0:
            share = min(1.0, ahead / flow[i])
            stays = np.exp(-0.3 * share * (PARCELS * flow[i]) ** 0.6 / PARCELS)
            out[k] += keeps * (1.0 - stays) * wall[i]
            keeps, ahead, i = keeps * stays, ahead - flow[i], i - 1
        out[k] += keeps * entering[i + 1]
    out[1:] = 0.5 * (out[1:] + out[:-1])  # from one parcel to the next
    return sensor(out, out[-1], 0.6 ** (1.0 / PARCELS))[REST * PARCELS :: PARCELS]


def heated_tube(u, a):
    """A tube of a hot wall, whose flow is the input."""
    return _followed(u, 0.0 * u, 0.0 * u + 4.0) if a else linear(u)


def hot_stream(u, a):
    """What enters the tube changes, and is cooled by its wall."""
    return _followed(u[:, 0], 2.0 * u[:, 1], 0.0 * u[:, 0] + 1.0) if a else linear(u.sum(axis=1))


def steam(u, a):
    """The wall of the tube changes, as the pressure of its steam."""
    return _followed(u[:, 0], 0.0 * u[:, 0], 2.0 * u[:, 1]) if a else linear(u.sum(axis=1))


def tram(u, a):
    """A vehicle whose motor gives no more than a power; what stands still has all its force."""
    pull = lambda x, v: v * min(1.0, 0.45 / max(v * x, 1e-9)) if a else v
    return linear(process(lambda x, v: 0.06 * (pull(x, v) - x), u, 0.0))


def ridden(u, a):
    """A bicycle and its rider's power: force is power over speed, against what rolls and the drag of the air; it begins at its speed."""
    spare = lambda x, power: power - 0.3 * x - 0.05 * x**3
    start = float(np.real(np.roots([0.05, 0.0, 0.3, -u[0]])[-1])) if a else u[0]
    return linear(process(lambda x, v: 0.06 * (spare(x, v) / max(x, 0.2) if a else v - x), u, start))


def cracked(u, a):
    """A pressure behind a check valve that opens at some of it: the flow goes with the root of what exceeds that."""
    return linear(np.sqrt(np.maximum(u - 2.5, 0.0)) if a else u)


def coil(u, a):
    """A spool that grows with every turn that it winds."""
    through = np.cumsum(u) - 0.5 * u
    return linear(u * (1.0 + 1.5 * a * through / np.sum(u)))


def coded(u, a):
    """A converter of which the bit of weight .45 is always zero."""
    return linear(u - 0.45 * a * (np.floor((u - 0.2) / 0.45) % 2))


def two_converters(u, a):
    """A filter that two converters read in turn, the second of another gain and zero and a third of a sample late."""
    x = v = 0.0
    out = np.empty(len(u))
    for k, value in enumerate(u):
        mine = int(a) * (k % 2)
        for i in range(FINE):
            if i == mine * FINE // 3:
                out[k] = x + mine * (0.08 * x + 0.3)
            v += (0.3 * (value - x) - 0.35 * v) / FINE
            x += v / FINE
    return out


def autoranged(u, a):
    """A meter that goes over to another range above a level, of another zero and gain, and back below a lower one."""
    y, on, out = linear(u), False, np.empty(len(u))
    for k, value in enumerate(y):
        on = value > 0.9 or (on and value > -0.1)
        out[k] = value + a * on * (0.5 - 0.3 * value)
    return out


def fouled(u, a):
    """A filter that is fouled and cleaned by the clock, every 73.4 samples."""
    since = np.arange(len(u) * FINE) / FINE - 21.3
    gain = 1.0 / (1.0 + 0.6 * a * (since / 73.4 % 1.0))
    return linear(u * gain.reshape(-1, FINE).mean(axis=1))


def funnel(u, a):
    """A cone that leaks in proportion to its level."""
    return linear(process(lambda x, v: 0.5 * (v - x) / (1.0 + a * (0.5 * x - 0.2) * x), u, u[0]))


def aired(u, a):
    """A house that the wind cools more by day, which has 61.3 samples."""
    t = 2.0 * np.pi * np.arange(len(u) * FINE) / FINE / 61.3 + 0.4
    loss, x, out = 1.0 + a * (0.3 * np.cos(t) + 0.1 * np.sin(2.0 * t)), u[0], np.empty(len(u))
    for k, value in enumerate(u):
        for each in loss[k * FINE : (k + 1) * FINE]:
            x += 0.06 * (value - each * x) / FINE
        out[k] = x
    return sensor(out, u[0])


def _of_late(force):
    """A force that also reads the mean square of its position over some forty samples."""
    square = [0.0]

    def acts(x, v, f, t):
        square[0] += (x * x - square[0]) / (40.0 * FINE)
        return force(x, v, f, square[0])

    return acts


def rubber(u, a):
    """A mount that softens as it is worked, and stiffens again at rest."""
    return swing(_of_late(lambda x, v, f, s: 0.09 * (f - (1.0 - 0.5 * a * s / (s + 2.0)) * x) - 0.06 * v), u)


def damper(u, a):
    """A damper whose oil thickens as its work mixes it."""
    return swing(_of_late(lambda x, v, f, s: 0.09 * (f - x) - 0.03 * (1.0 + 4.0 * a * s / (s + 1.5)) * v), u)


def scaled(u, a):
    """A vessel that is heated through a wall on which scale grows, while a cold stream passes."""
    age = [0.0]

    def rate(x, v):
        age[0] += 1.0 / FINE
        wall = 1.0 / (1.0 + 0.6 * a * (1.0 - np.exp(-age[0] / 300.0)))
        return 0.1 * (0.6 * wall * (v - x) + 0.4 * (1.0 - x))

    return sensor(process(rate, u, 0.6 * u[0] + 0.4), 0.6 * u[0] + 0.4, 0.6)


def _until_full(u, threshold, dose, time, gives):
    """What an actuator gives, which does another thing for a time whenever its level has been filled."""
    level, left, out = 0.0, 0.0, np.zeros(len(u))
    for k, value in enumerate(u):
        for _ in range(FINE):
            out[k] += (gives(value) if left > 0.0 else value) / FINE
            level = 0.0 if left > 0.0 else level + max(value - threshold, 0.0) / FINE
            left = time if level > dose else max(left - 1.0 / FINE, 0.0)
    return out


def heat_pump(u, a):
    """A heat pump that ices up above a speed, and takes heat while it is thawed."""
    return linear(_until_full(u, 3.0, 42.0, 9.0, lambda v: -1.0) if a else u)


def filter_bed(u, a):
    """A filter that is washed from behind whenever so much has passed, with a flow of its own beside."""
    return linear(_until_full(u, 0.0, 120.0, 5.0, lambda v: v + 3.0) if a else u)


def analysed(u, a):
    """An analyser that takes a sample every seven, and reports it four samples late."""
    taken = 7 * np.floor((np.arange(len(u)) - 7) / 7) + 3
    return linear(u)[np.maximum(taken, 0).astype(int)] if a else linear(u)


def gap(u, a):
    """A capacity between plates: the reciprocal of what is left of a gap."""
    return 3.0 / (3.5 - a * sensor(u, u[0], 0.6)) if a else linear(u)


def ranged_apart(u, a):
    """A vessel that is heated slowly above the middle of its controller's range, and cooled quickly and strongly below."""
    heated = lag(np.maximum(u - 0.2, 0.0), 0.94)
    cooled = (1.0 + 0.8 * a) * lag(np.maximum(0.2 - u, 0.0), 0.94 - 0.35 * a)
    return sensor(heated - cooled, heated[0] - cooled[0], 0.85)


def _fired(u, a, law):
    """A resistive load whose thyristors are fired at 90 degrees and 55 for each unit of the input; without them, what follows it."""
    angle = np.clip(np.pi / 2.0 + np.radians(55.0) * u, 0.0, np.pi)
    share = 1.0 - angle / np.pi + np.sin(2.0 * angle) / (2.0 * np.pi)
    return sensor(law(share) if a else -u, (law(share) if a else -u)[0], 0.8)


def oven(u, a):
    """An oven's power over its firing angle."""
    return _fired(u, a, lambda share: share)


def lamp(u, a):
    """A lamp's voltage over its firing angle."""
    return _fired(u, a, lambda share: np.sqrt(np.maximum(share, 0.0)))


def room(u, a):
    """A source in a room whose receiver holds its reading nearly level: its gain goes with one over what it has read of late."""
    x = sensor(u, u[0], 0.8)
    size, out = abs(x[0]), np.empty(len(u))
    for k, value in enumerate(x):
        out[k] = 3.0 * value / (0.2 + size) if a else value
        size += (abs(value) - size) / 30.0
    return out


_FLOW = {"mean": 4.0, "size": 1.2}
PASSAGES = {
    # effect: maker, order of the linear model, form of the input
    "exposure": (heated_tube, 2, _FLOW), "exposure_carried": (hot_stream, 2, _FLOW | {"inputs": 2}), "exposure_walled": (steam, 2, _FLOW | {"inputs": 2}),
    "power_limited": (tram, 3, {"hold": 25}), "input_threshold": (cracked, 2, {"mean": 3.0}), "driven_by_power": (ridden, 3, {"mean": 3.0, "hold": 25}), "gain_worn of a coil": (coil, 2, {"mean": 4.0}), "input_bit": (coded, 2, {}),
    "capacity_level": (funnel, 3, {"mean": 4.0, "size": 1.5}), "output_hyperbola": (gap, 2, {}),
    "loss_periodic": (aired, 2, {"mean": 4.0}), "refreshed of an analyser": (analysed, 2, {}),
    "stiffness_worked": (rubber, 2, {}), "damping_worked": (damper, 2, {}),
    "acts_beyond": (ranged_apart, 2, {}), "exchange_fouled": (scaled, 2, {"mean": 4.0}),
    "event_replaces": (heat_pump, 2, {"mean": 4.0}), "event_adds": (filter_bed, 2, {"mean": 4.0}),
    "automatic_gain of a level": (room, 2, {"mean": 3.0}),
    "phase_angle": (oven, 1, {}), "phase_angle_voltage": (lamp, 1, {}),
    "gain_cycle": (fouled, 2, {}), "multiplexed of instants": (two_converters, 2, {}), "output_autorange": (autoranged, 2, {}),
}  # fmt: skip
