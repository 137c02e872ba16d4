"""What is no part of the plant: signals added to the output, and noise and faults of a measurement, which are not simulated."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.effects.effect import Clock, Effect, Nature, Slot, numbered
from estimators.diagnosis.effects.input import after, kept
from estimators.residual.algebra import decomposed

Array = NDArray[Any]
MOST_GROWTH = 6.0
"""Power of its frequency that the size of a disturbance may go with: what is out of balance has 2."""
TURNED = 16.0
"""Over the record's length squared, how far apart the rates of change are that a frequency is tried with: half of it off, a line
keeps nine tenths of its power."""
CLOSER = 8  # rates between two of them, beside the best
TONE = {"frequency": "rad/sample", "cosine": "y", "sine": "y"}
OVERTONES, MOST_OVERTONES, PARTS = 6, 30, (1, 2, 3)
"""Harmonics that a period is looked for by, as a pulse or a sawtooth has them; at most, as an edge has; which of them the highest line may be."""


def _tones(y: Array, p: Array, clock: Clock) -> Array:
    total = np.zeros(len(clock.k))
    for tone in p.reshape(-1, 3):
        cosine, sine = _waves(tone, clock)
        total += tone[1] * cosine + tone[2] * sine
    return y + total


def _tones_by_size(p: Array, clock: Clock) -> Iterator[tuple[int, Array]]:
    for i, tone in enumerate(p.reshape(-1, 3)):
        yield from enumerate(_waves(tone, clock), 3 * i + 1)


def _highest_peaks(channel: Any, base: Any, count: int) -> tuple[Array, Array] | None:
    """Sinusoids at the highest peaks of the residual's periodogram, taken out one after another: parameters and sizes."""
    n, k = len(channel), channel.clock.k
    if n < 20:
        return None
    r = np.where(channel.keep, base.residual, 0.0)
    pad = 8 * n
    omega = 2 * np.pi * np.arange(pad // 2 + 1) / pad
    lines: list[float] = []
    columns: list[Array] = []
    theta, rest = np.zeros(0), r - r.mean()
    gain = np.abs(np.fft.rfft(np.concatenate(([1.0], base.noise)), pad)) ** 2
    for _ in range(count):
        power = np.abs(np.fft.rfft(rest * np.hanning(n) if lines else rest, pad)) ** 2 * gain
        power[omega < 2 * np.pi * 1.2 / n] = 0.0
        for w in lines:
            power[np.abs(omega - w) < 2 * np.pi * 1.0 / n] = 0.0
        w = float(omega[int(np.argmax(power))])
        lines.append(w)
        columns += [np.cos(w * k), np.sin(w * k)]
        X = np.stack(columns, axis=1)
        theta = np.linalg.lstsq(X, r, rcond=None)[0]
        rest = r - X @ theta
    p = np.concatenate([[w, theta[2 * i], theta[2 * i + 1]] for i, w in enumerate(lines)])
    size = float(np.std(r)) + 1e-300
    return p, np.tile([1.0 / n, size, size], count)


def in_series(p: Array, clock: Clock) -> Array:
    """(N,) a signal of one period: its frequency, then the cosine's and sine's size of each harmonic."""
    k: Any = clock.k
    if not isinstance(k, np.ndarray):  # a symbol
        waves = _overtones_at(k, p[0], len(p) // 2)
        total: Any = sum((c * wave for c, wave in zip(p[1:], waves, strict=True)), 0.0 * k)
        return total
    return p[1:] @ _waves(p, clock)


def harmonics(unit: str) -> dict[str, Any]:
    """The parameters of an effect that goes with a signal of one period, as `in_series` takes them, one harmonic or several."""
    waves = {"cosine": unit, "sine": unit}

    def shape(size: int, order: int) -> list[tuple[str, str]]:
        return [("frequency", "rad/sample"), *(numbered(waves, size) if size > 1 else waves.items())]

    return {"parameters": {"frequency": "rad/sample"} | waves, "shape": shape}


def _waves(p: Array, clock: Clock) -> Array:
    """(sizes, N) of the harmonics of a signal of one period."""
    return kept(_in_turn, clock.k, np.array([p[0], len(p) // 2]))


def _in_turn(k: Array, p: Array) -> Array:
    return np.array(_overtones_at(k, p[0], int(p[1])))


def _overtones_at(k: Any, w: float, count: int) -> list[Any]:
    """Cosine and sine of each harmonic: of the one before, turned once more."""
    cosine, sine = np.cos(w * k), np.sin(w * k)
    waves = [cosine, sine]
    for _ in range(count - 1):
        last = waves[-2:]
        waves += (last[0] * cosine - last[1] * sine, last[0] * sine + last[1] * cosine)
    return waves


def _repeating(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A signal of one period, of which the highest line is a harmonic; of the periods near it, the one whose harmonics explain most."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    n, use, highest = len(channel), channel.keep, _highest_peaks(channel, base, 1)
    if highest is None:
        return
    line, r = highest[0], base.residual

    def left(w: float, count: int) -> tuple[float, Array]:
        X = _harmonics(channel.clock.k, w, count)
        c = np.linalg.lstsq(X[use], r[use], rcond=None)[0]
        return float(np.sum((r - X @ c)[use] ** 2)), np.concatenate(([w], c))

    best, p = left(line[0], 1)[0], None
    less = np.exp(-FIRM / base.n)
    if not best < less * np.sum(r**2):
        return
    near = np.linspace(-0.5, 0.5, 4 * OVERTONES + 1) * 2.0 * np.pi / (n * OVERTONES)
    for part in PARTS:  # a longer period has the harmonics of a shorter one, and more
        trial = min((left(line[0] / part + by, OVERTONES) for by in near), key=lambda found: found[0])
        best, p = trial if trial[0] < less * best else (best, p)
    if p is None:
        return
    size = float(np.std(r)) + 1e-300
    scales = np.concatenate((base.scales, [1.0 / n], np.full(2 * OVERTONES, size)))
    s = base.structure.adding(Part(WAVEFORM, 0, OVERTONES))
    f = fit(channel, s, np.concatenate((base.p, p)), scales, noise=base.noise, iterations=15)
    yield f
    more = _overtones(channel, f) - OVERTONES
    if more > 0:
        s = base.structure.adding(Part(WAVEFORM, 0, OVERTONES + more))
        p, scales = np.append(f.p, np.zeros(2 * more)), np.append(scales, np.full(2 * more, size))
        yield fit(channel, s, p, scales, noise=f.noise, iterations=15)


def _harmonics(k: Array, w: float, count: int) -> Array:
    """(N, 2 count) cosine and sine of each harmonic."""
    turns = k[:, None] * w * np.arange(1, count + 1)
    return np.stack((np.cos(turns), np.sin(turns)), axis=2).reshape(len(k), -1)


def _overtones(channel: Any, f: Any) -> int:
    """How many harmonics Schwarz's criterion asks for, by what they have in common with a fit's residual as its noise model sees it."""
    w, count = abs(float(f.p[f.structure.slices()[-1].start])), f.structure.parts[-1].size
    most = max(count, int(min(np.pi / max(w, 1e-300), MOST_OVERTONES)))
    whiten = np.concatenate(([1.0], f.noise))
    seen = channel.keep[:, None] * np.column_stack((_harmonics(channel.clock.k, w, most), f.residual))
    *X, e = lfilter(whiten, [1.0], seen, axis=0).T
    Q = np.linalg.qr(np.array(X).T)[0]
    told = np.cumsum((Q.T @ e) ** 2)[1::2]
    sizes = np.arange(1, most + 1)
    asked = f.n * np.log(np.maximum(1.0 - told / (float(e @ e) + 1e-300), 1e-12)) + 2.0 * sizes * np.log(f.n)
    return int(sizes[np.argmin(np.where(sizes < count, np.inf, asked))])


def _hidden(channel: Any, base: Any) -> Iterator[Any]:
    """A sinusoid that the linear model has taken for dynamics: in place of poles that ring through the whole record, and a
    slow swing beside an autoregression, as the residual of a model that was spoilt by it says little of it."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    s, k, found = base.structure, channel.clock.k, []
    if s.layout != "tf" or s.effects:
        return
    poles = np.roots(np.concatenate(([1.0], base.p[: s.order])))
    ringing = [z for z in poles if z.imag > 0 and abs(z) > 1.0 - 3.0 / len(channel)]
    if ringing and s.order >= 3:
        w = float(np.angle(max(ringing, key=abs)))
        X = np.stack([np.cos(w * k), np.sin(w * k)], axis=1)
        found.append((w, np.linalg.lstsq(X[channel.keep], channel.y[channel.keep], rcond=None)[0]))
    if (swing := _swing(channel, s)) is not None:
        found.append(swing)
    size = float(np.std(channel.y)) + 1e-300
    for w, c in found:
        X = np.stack([np.cos(w * k), np.sin(w * k)], axis=1)
        linear = fit_linear(replace(channel, y=channel.y - X @ c), s)
        p = np.concatenate((linear.p, [w], c))
        scales = np.concatenate((linear.scales, [1.0 / len(channel), size, size]))
        yield fit(channel, s.adding(Part(TONES)), p, scales, noise=base.noise, iterations=25)


TURNS = np.arange(1.2, 8.0, 0.2)
"""Turns of a slow swing in a record: fewer are a drift, more stand out of a linear model's residual."""
FIRM = 60.0
"""Likelihood ratio of a swing beside an autoregression from which on it is tried: far beyond the chance of 34 frequencies; and of
what repeats, beside its highest line."""


def _swing(channel: Any, s: Any) -> tuple[float, Array] | None:
    """Angular frequency, cosine and sine of the slow sinusoid at the output that helps an autoregression most."""
    n, lags = len(channel), range(1, s.order + 1)
    late = lambda x, i: np.concatenate((np.repeat(x[:1], i), x[: n - i]))
    columns = [late(channel.y, i) for i in lags] + [np.ones(n)]
    columns += [late(channel.u[:, j], i + s.delay) for j in s.inputs for i in range(s.order + 1)]
    use, k, Z = channel.keep, channel.clock.k, np.stack(columns, axis=1)
    Q = np.linalg.qr(Z[use])[0]
    rest = channel.y[use] - Q @ (Q.T @ channel.y[use])
    left, best = float(rest @ rest), (FIRM, 0.0)
    if n < 100 or left <= 0.0:
        return None
    for w in 2 * np.pi * TURNS / n:
        C = np.stack([np.cos(w * k), np.sin(w * k)], axis=1)[use]
        C = C - Q @ (Q.T @ C)
        after = rest - C @ np.linalg.lstsq(C, rest, rcond=None)[0]
        best = max(best, (len(rest) * float(np.log(left / max(float(after @ after), 1e-300))), float(w)))
    w = best[1]
    if w == 0.0:
        return None
    X = np.column_stack((Z, np.cos(w * k), np.sin(w * k)))[use]
    theta = decomposed(X, channel.y[use])
    through = 1.0 - np.sum(theta[: s.order] * np.exp(-1j * w * np.array(lags)))
    out = (theta[-2] - 1j * theta[-1]) / through
    return w, np.array([out.real, -out.imag])


def _tone_fits(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    before = np.inf
    for count in (1, 2, 3):
        found = _highest_peaks(channel, base, count)
        if found is not None:
            p, scales = np.concatenate((base.p, found[0])), np.concatenate((base.scales, found[1]))
            f = fit(
                channel,
                base.structure.adding(Part(TONES, 0, count)),
                p,
                scales,
                noise=base.noise,
                iterations=15,
            )
            yield f
            if f.criterion > before:
                break
            before = f.criterion
    yield from _hidden(channel, base)


@lru_cache(maxsize=1)  # asked of a record and a model for what is added and for what acts beside the input
def swept_line(channel: Any, base: Any) -> tuple[float, float]:
    """Frequency at the clock's zero and rate of the line that is highest when the residual is mixed down by sweeps of many rates, also
    past half the sampling rate."""
    n, k = len(channel), channel.clock.k - channel.clock.k[0]
    r = np.where(channel.keep, base.residual, 0.0)
    r = np.convolve(r - r.mean(), np.concatenate(([1.0], base.noise)))[:n]
    fast = 2 << n.bit_length()  # at least twice the record, a power of two

    def line(rate: float) -> tuple[float, float, float]:
        power = np.abs(np.fft.fft(r * np.exp(-0.5j * rate * k**2), fast)) ** 2
        at = int(np.argmax(power))
        return float(power[at]), 2 * np.pi * at / fast, float(rate)

    step = TURNED / n**2  # of a real signal, a rate and its negative are one
    rate = max(map(line, np.arange(step, np.pi / n, step)))[2]
    _, w, rate = max(map(line, rate + step * np.linspace(-1.0, 1.0, 2 * CLOSER + 1)))
    return w - rate * channel.clock.k[0], rate


def _sweeping(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """A sinusoid whose frequency changes steadily."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.structure import Part

    n = len(channel)
    if n < 100 or base.structure.effects:
        return
    line, size = swept_line(channel, base), float(np.std(base.residual)) + 1e-300
    turns = turning(channel.clock.k, *line)
    p = np.concatenate((base.p, line, np.linalg.lstsq(turns, base.residual, rcond=None)[0]))
    scales = np.concatenate((base.scales, [1.0 / n, 1.0 / n**2, size, size]))
    yield fit(channel, base.structure.adding(Part(SWEEP)), p, scales, noise=base.noise, iterations=25)


def turning(k: Array, frequency: float, rate: float) -> Array:
    """(N, 2) cosine and sine of a frequency that changes at a rate."""
    turn = frequency * k + 0.5 * rate * k**2
    return np.stack((np.cos(turn), np.sin(turn)), axis=1)


def begun_beside(channel: Any, base: Any, signal: Array) -> tuple[Any, dict[int, float]]:
    """The fit with the plant of a linear model that has one more signal (N,) at its inputs, and how much of that adds to each of them."""
    from estimators.diagnosis.model.linear import fit_linear, plant_scales

    few, p, scales = base.structure, base.p.copy(), base.scales.copy()
    wide = replace(channel, u=np.column_stack((channel.u, signal)))
    begun = fit_linear(wide, replace(few, inputs=(*few.inputs, channel.u.shape[1]))).p
    *rows, more = begun[few.order : few.order + (len(few.inputs) + 1) * few.taps].reshape(-1, few.taps)
    p[: few.plant_size] = begun[: few.plant_size]
    scales[: few.plant_size] = plant_scales(few, p)
    sizes = (float(row @ more) / (float(row @ row) + 1e-300) for row in rows)
    return replace(base, p=p, scales=scales), dict(zip(few.inputs, sizes, strict=True))


def swept(y: Array, p: Array, clock: Clock) -> Array:
    """(N,) a signal with a sinusoid of steadily changing frequency added."""
    turn = p[0] * clock.k + 0.5 * p[1] * clock.k**2
    return y + p[2] * np.cos(turn) + p[3] * np.sin(turn)


def run_up(x: Any, p: Array, clock: Clock) -> Any:
    """The same, its size a power of its frequency: 2 for what is out of balance, 0 for what is pushed."""
    power = min(max(float(p[4]), -MOST_GROWTH), MOST_GROWTH)
    grown = np.exp(power * np.log(np.abs(1.0 + p[1] * clock.k / (p[0] or 1e-12)) + 1e-6))
    return x + grown * swept(0.0 * x, p, clock)


def _added(key: str, cause: str, sentence: str, **fields: Any) -> Effect:
    return Effect(key=key, cause=cause, nature=Nature.ADDED, slot=Slot.ADDED, sentence=sentence, **fields)


OFFSET = _added(
    "offset", "output_offset", "a constant is added", parameters={"offset": "y"}, amplitude=0,
    apply=lambda y, p, c: y + p[0], starts=lambda s: ([[0.05 * s.sy]], [s.sy]), slopes=lambda p, c: [(0, np.ones(len(c.k)))],
)  # fmt: skip


def level_at(s: Any) -> int | None:
    """Which parameter of a structure is the constant that is added, None where none is."""
    return next(
        (sl.start for part, sl in zip(s.parts, s.slices(), strict=True) if part.effect is OFFSET), None
    )


TONES = _added(
    "tones", "periodic_disturbance", "a sinusoid is added", parameters=TONE, per_sample=True, apply=_tones, slopes=_tones_by_size,
    shape=lambda size, order: numbered(TONE, size) if size > 1 else list(TONE.items()), search=_tone_fits,
)  # fmt: skip

WAVEFORM = _added(
    "waveform", "periodic_disturbance", "a signal that repeats is added, of any form: its period and its harmonics", per_sample=True,
    apply=lambda y, p, c: y + in_series(p, c), slopes=lambda p, c: enumerate(_waves(p, c), 1), trials=10.0, search=_repeating, **harmonics("y"),
)  # fmt: skip

SWEEP = _added(
    "sweep", "periodic_disturbance", "a sinusoid of steadily changing frequency is added", per_sample=True, trials=20.0,
    parameters={"frequency": "rad/sample", "rate": "rad/sample^2", "cosine": "y", "sine": "y"}, apply=swept, search=_sweeping,
)  # fmt: skip

ADDED = (
    OFFSET,
    _added("drift", "output_drift", "a trend is added", parameters={"offset": "y", "slope": "y/record"},
           apply=lambda y, p, c: y + p[0] + p[1] * c.turn,
           starts=lambda s: ([[a * s.sy, b * s.sy] for a in (-0.1, 0.1) for b in (-0.2, 0.2)], [s.sy, s.sy])),
    _added("step_output", "step_disturbance", "a step is added to the output", parameters={"size": "y", "time": "sample"},
           trials=0.03, per_sample=True, amplitude=0, family="steps", apply=lambda y, p, c: y + p[0] * after(c, p[1]),
           starts=lambda s: ([[0.05 * s.sy, t] for t in s.times()], [s.sy, 1.0])),
    TONES,
    WAVEFORM,
    SWEEP,
)  # fmt: skip


def _seen(key: str, cause: str, nature: Nature, sentence: str, trials: float = 1.0) -> Effect:
    return Effect(key=key, cause=cause, nature=nature, slot=Slot.NOISE, sentence=sentence, trials=trials)


NOISE = (
    _seen("coloured", "coloured_noise", Nature.NOISE, "the noise is correlated in time", 3),
    _seen("feedback", "closed_loop", Nature.NOISE, "the input follows the noise: feedback"),
    _seen("outliers", "outliers", Nature.NOISE, "single samples are far off"),
    _seen("quantised", "quantisation", Nature.SAMPLING, "the output is rounded"),
    _seen("held", "dropouts", Nature.SAMPLING, "samples are lost and the last one is repeated"),
)
