"""The rest test of a rig: noise and drift while the input rests, gain, delay and settling from one small pulse per input.

The input is at its level for four pieces, then for every input up by a small step for one piece and back for one. A piece
is a ninth of an experiment, so that for no number of inputs its record has the length of one. What it finds decides nothing by itself: it warns of outputs that would leave their range,
of responses below the noise, and of delays, drifts and tails that the session's settings do not expect."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from estimators.sessions.checking import (
    check_input,
    check_output,
    check_reference,
    faults,
    fitting_factor,
    read_output,
)
from estimators.sessions.folder import KEPT
from estimators.sessions.layout import rig_samples
from estimators.sessions.settings import Settings
from estimators.sessions.stored import StoredSession, read_signal, signal_csv
from oed.covariances import of_few
from oed.errors import CampaignError, InputError
from oed.files.limits import file_content
from oed.files.writing import write_whole

Array = NDArray[np.float64]
QUIET, HALVES = 4, 8
"""Pieces without excitation, and the half pieces in them, whose means say how well a level is known."""
SHORTEST = 32
"""Samples of a piece at the least: the scatter of means over fewer says nothing."""
SHARE = 0.1
"""Height of the pulses over the largest input: small, since nothing is known of the rig yet."""
FALSE_ALARM = 0.01
"""Chance that noise alone, if Gaussian, is taken for a pulse's response."""
SURE = 3.0
"""Standard errors beyond which a drift or a movement counts."""
WEAK = 1.0
"""Ratio of response to noise below which single samples show nothing of the input."""


@dataclass(frozen=True)
class RestTest:
    """What a rest test found; i output, j input. `rows` of the test; `pulse` [j] height of each pulse in the
    input's unit; `level` [i] mean output at rest; `noise` [i] standard deviation about the line of the rest;
    `resolution` [i] smallest step between readings where they repeat, else 0; `drift` [i] slope per second
    and its standard error; `gain` [i][j] output over input at the end of the pulse and its standard error;
    `response` [i][j] largest output over input within it, 0 where none was seen; `settled` [i][j] whether it
    had come to rest; `delay` [i][j] samples until it left the noise, so at most so many; None where no sample
    did; `tail` [i][j] samples until it had died out after the pulse; None where it had not."""

    rows: int
    pulse: tuple[float, ...]
    level: tuple[float, ...]
    noise: tuple[float, ...]
    resolution: tuple[float, ...]
    drift: tuple[tuple[float, float], ...]
    gain: tuple[tuple[tuple[float, float], ...], ...]
    response: tuple[tuple[float, ...], ...]
    settled: tuple[tuple[bool, ...], ...]
    delay: tuple[tuple[int | None, ...], ...]
    tail: tuple[tuple[int | None, ...], ...]

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)

    def sentences(self, s: Settings) -> list[str]:
        """What was found, with units."""
        said = []
        for i, name in enumerate(s.outputs):
            unit = f" {s.output_units[i]}".rstrip()
            slope, error = self.drift[i]
            drift = f"drift {slope:.3g} +- {error:.2g}{unit}/s" if self._drifts(i) else "no drift seen"
            coarse = f", read in steps of {self.resolution[i]:.3g}{unit}" if self.resolution[i] else ""
            said.append(
                f"{name} at rest: {self.level[i]:.6g}{unit}, noise {self.noise[i]:.3g}{unit} rms{coarse}, {drift}"
            )
            per = f"{s.output_units[i] or name}/"
            for j, cause in enumerate(s.inputs):
                if not self.response[i][j]:
                    said.append(
                        f"{cause} to {name}: no response seen to a pulse of {self.pulse[j]:.3g} {s.input_units[j]}".rstrip()
                    )
                    continue
                gain, error, seen = *self.gain[i][j], self.delay[i][j]
                late = (
                    "no sample above the noise"
                    if seen is None
                    else f"delay at most {seen} sample{'s' * (seen != 1)} ({seen * s.dt:.3g} s)"
                )
                still = "" if self.settled[i][j] else ", still moving"
                said.append(
                    f"{cause} to {name}: gain {gain:.3g} +- {error:.2g} {per}{s.input_units[j] or cause} at the end of the "
                    f"pulse{still}; {late}"
                )
        return said

    def _drifts(self, i: int) -> bool:
        slope, error = self.drift[i]
        return abs(slope) > SURE * error

    def warnings(self, s: Settings) -> list[str]:
        """What the session's settings do not go with, each with its remedy."""
        sizes = _sizes(s)
        low, high = _expected(self, s, np.asarray(s.level) + sizes, np.asarray(s.level) - sizes)
        said = _beyond(s, low, high, "lower --amplitude or --power")
        for i, name in enumerate(s.outputs):
            unit = f" {s.output_units[i]}".rstrip()
            largest = max(r * a for r, a in zip(self.response[i], sizes, strict=True))
            if not largest:
                said.append(f"{name} showed no response: repeat with a larger `oed session rest DIR --share`; where that shows none either, check the wiring or raise --amplitude")  # fmt: skip
            elif largest < WEAK * self.noise[i]:
                said.append(f"{name} would answer the largest input with {largest:.3g}{unit}, and its noise is {self.noise[i]:.3g}{unit} rms: raise --amplitude or --power, or average periods (--periods)")  # fmt: skip
            if abs(self.level[i]) > self.noise[i] and not (s.lead or s.centre):
                said.append(f"{name} rests at {self.level[i]:.6g}{unit} and the session takes outputs as deviations from 0: take the resting output off with --lead, or the mean with --centre")  # fmt: skip
            moved = abs(self.drift[i][0]) * rig_samples(s) * s.dt
            if self._drifts(i) and moved > self.noise[i] and not (s.lead or s.centre):
                said.append(f"{name} drifts by {moved:.3g}{unit} in one experiment, more than its noise: take the resting output off with --lead, or the mean with --centre")  # fmt: skip
            delays = [d for d in self.delay[i] if d is not None]
            if s.method in ("two-stage", "sequential") and delays and min(delays) > s.delay + 1:
                said.append(f"{name} was first seen to move after {min(delays)} samples, and the session's model has a delay of {s.delay}: compare the orders and delays of `oed identify`, and start with --delay")  # fmt: skip
            slow = [t for t, r in zip(self.tail[i], self.response[i], strict=True) if r]
            if slow and (None in slow or max(t or 0 for t in slow) > s.rest) and not s.periodic:
                tail = "more than the test saw" if None in slow else f"{max(t or 0 for t in slow)} samples"
                said.append(f"{name} takes {tail} to come to rest, and --rest is {s.rest}: wait that long between experiments, or raise --rest")  # fmt: skip
        return said


def _sizes(s: Settings) -> Array:
    """The largest deviation of every input that the settings lead to expect, (nu,)."""
    if s.amplitude is not None:
        return np.asarray(s.amplitude)
    if s.power is not None:  # a sinusoid's peak, the power shared
        return np.full(s.n_inputs, np.sqrt(2 * s.power / s.n_inputs))
    return np.sqrt(2 * np.asarray(s.energy, dtype=float) / s.samples)


def rest_input(s: Settings, share: float) -> Array:
    """The input of a rest test, its pulses a share of the largest deviation, within all limits: returns
    (rows, nu)."""
    if not 0 < share <= 1:
        raise InputError(f"the share is {share}; it is that of the largest input, above 0 and at most 1.")
    piece = max(s.samples // 9, SHORTEST)
    u = np.zeros(((QUIET + 2 * s.n_inputs) * piece, s.n_inputs))
    for j, size in enumerate(_sizes(s)):
        u[(QUIET + 2 * j) * piece : (QUIET + 2 * j + 1) * piece, j] = share * size
    whole = u + np.asarray(s.level)
    whole = fitting_factor(whole, s)[0] * u + np.asarray(s.level)
    check_input(whole, s)
    return whole


def rest_test(u: Array, y: Array, s: Settings) -> RestTest:
    """What the record of a rest test says: u (rows, nu) from `rest_input`, y (rows, ny)."""
    nu, ny = s.n_inputs, s.n_outputs
    piece = len(u) // (QUIET + 2 * nu)
    quiet, t = y[: QUIET * piece], np.arange(QUIET * piece) * s.dt
    line = np.polynomial.polynomial.polyfit(t, quiet, 1)
    about = quiet - (line[0] + np.outer(t, line[1]))
    noise = np.sqrt(np.sum(about**2, axis=0) / (len(about) - 2))
    half = len(about) // HALVES
    means = about[: HALVES * half].reshape(HALVES, half, ny).mean(axis=1)
    spread = of_few(1.0, HALVES - 2) * np.sqrt(np.sum(means**2, axis=0) / (HALVES - 2))
    # of the mean of half a piece; white noise is the least
    spread = np.maximum(spread, noise / np.sqrt(half))
    centres = (np.arange(HALVES) - (HALVES - 1) / 2) * half * s.dt
    slope_error = spread / np.sqrt(np.sum(centres**2))
    steps = [np.diff(np.unique(column)) for column in quiet.T]
    coarse = [float(d.min()) if len(d) and len(d) + 1 < len(quiet) / 2 else 0.0 for d in steps]
    least = norm.isf(FALSE_ALARM / 2 / piece) * noise * np.sqrt(1 + 1 / piece)
    least = np.maximum(least, 1e-9 * np.abs(y).max(axis=0))  # rounding is no response
    moving = np.where(np.abs(line[1]) > SURE * slope_error, line[1], 0.0)
    y = y - np.outer(np.arange(len(y)) * s.dt, moving)  # a drift that is sure is no response either
    heights, table = [], []
    for j in range(nu):
        begin = (QUIET + 2 * j) * piece
        height = float(u[begin, j] - s.level[j])
        heights.append(height)
        before = y[begin - piece : begin].mean(axis=0)
        pulse, after = y[begin : begin + piece] - before, y[begin + piece : begin + 2 * piece] - before
        table.append(
            [_answer(pulse[:, i], after[:, i], height, float(least[i]), float(spread[i])) for i in range(ny)]
        )
    by = lambda key: tuple(tuple(table[j][i][key] for j in range(nu)) for i in range(ny))
    pairs = lambda a, b: tuple(zip(map(float, a), map(float, b), strict=True))
    return RestTest(
        len(u), tuple(heights), tuple(map(float, quiet.mean(axis=0))), tuple(map(float, noise)), tuple(coarse),
        pairs(line[1], slope_error), by("gain"), by("response"), by("settled"), by("delay"), by("tail"),
    )  # fmt: skip


def _answer(pulse: Array, after: Array, height: float, least: float, spread: float) -> dict[str, Any]:
    """One output's answer to one pulse: pulse (piece,), after (piece,)."""
    half = len(pulse) // 2
    end, halfway = pulse[half:].mean(), pulse[half : half + half // 2].mean()
    seen, alive = np.flatnonzero(np.abs(pulse) > least), np.flatnonzero(np.abs(after) > least)
    tail = int(alive[-1]) + 1 if len(alive) else 0
    error = spread * np.sqrt(1.5)  # the mean of half a piece less that of a whole one
    largest = max(np.abs(pulse[seen]).max(initial=0.0), abs(end) if abs(end) > SURE * error else 0.0)
    return {
        "gain": (float(end / height), float(error / abs(height))),
        "response": float(largest / abs(height)),
        "settled": bool(abs(end - halfway) <= SURE * error),
        "delay": int(seen[0]) if len(seen) else None,
        "tail": tail if tail < len(after) else None,
    }


def _expected(found: RestTest, s: Settings, *inputs: Array) -> tuple[Array, Array]:
    """Lowest and highest output to expect at the least: that of steps as large as the inputs' largest values;
    inputs (nu,) or (rows, nu), about their levels; returns (ny,), (ny,)."""
    size = np.max([np.abs(np.atleast_2d(u) - np.asarray(s.level)).max(axis=0) for u in inputs], axis=0)
    reach = np.max(np.asarray(found.response) * size, axis=1)
    return np.asarray(found.level) - reach, np.asarray(found.level) + reach


def _beyond(s: Settings, low: Array, high: Array, remedy: str) -> list[str]:
    """A sentence for every output whose expected values leave its range or its abort level."""
    said = []
    for i, name in enumerate(s.outputs):
        bounds = [("range", *s.sensor_range[i])] if s.sensor_range is not None else []
        bounds += [("abort level", -s.abort[i], s.abort[i])] if s.abort is not None else []
        for what, lowest, highest in bounds:
            if low[i] < lowest or high[i] > highest:
                unit = f" {s.output_units[i]}".rstrip()
                said.append(f"{name} is expected between {low[i]:.3g} and {high[i]:.3g}{unit}, beyond its {what} of {lowest:g} to {highest:g}{unit}: {remedy}")  # fmt: skip
    return said


def ask_rest(session: StoredSession, share: float | None = None) -> Path:
    """Write the input of a rest test, or find it written where none of another share is asked for."""
    s, folder = session.settings, session.folder
    with folder.alone():
        made, done = folder.find("rest-input"), folder.find("rest-output")
        last = max(made, default=(0, 1))
        u = rest_input(s, SHARE if share is None else share)
        if (
            last in made
            and last not in done
            and (share is None or np.array_equal(u, read_signal(made[last], s.inputs)))
        ):
            return made[last]
        file = session.path / f"rest-input-{last[0] + 1:04d}.csv"
        write_whole(file, signal_csv(u, s.inputs, s.input_units, s.dt), kept=KEPT)
        folder.note(last[0] + 1, "rest-input", file)
        return file


def record_rest(session: StoredSession, path: Path) -> RestTest:
    """Check the output of the rest test that waits, store it, and say what it shows."""
    s, folder = session.settings, session.folder
    with folder.alone():
        made = folder.find("rest-input")
        if not made:
            raise InputError(f"no rest test was asked for; do so with `oed session rest {session.path}`.")
        last = max(made)
        u, reading = read_signal(made[last], s.inputs), read_output(path, s, last[0])
        check_output(reading.y, len(u), s)
        if reading.u is not None:
            check_reference(reading.u, u, [], s)
        fault = faults(reading.y, u, s, silent=True)
        if fault:
            raise InputError(
                f"the rest test is not used: {fault}. Repeat it, or ask for another one with --share."
            )
        file = session.path / f"rest-output-{last[0]:04d}.csv"
        content = signal_csv(reading.y, s.outputs, s.output_units, s.dt)
        if file.exists() and file_content(file) != content:
            raise InputError(
                f"rest test {last[0]} is recorded already; ask for another one with `oed session rest {session.path}`."
            )
        if not file.exists():
            write_whole(file, content, kept=KEPT)
            folder.note(last[0], "rest-output", file)
    return rest_test(u, reading.y, s)


def rest_of(session: StoredSession) -> RestTest | None:
    """What the last rest test of a session found, None where there is none."""
    s, folder = session.settings, session.folder
    done = folder.find("rest-output")
    if not done:
        return None
    last = max(done)
    folder.check_unchanged(done[last], file_content(done[last]))
    asked = folder.find("rest-input").get(last)
    if asked is None:
        raise CampaignError(f"rest-input-{last[0]:04d}.csv is missing from {session.path}; restore it.")
    u, y = read_signal(asked, s.inputs), read_signal(done[last], s.outputs)
    if not (len(u) == len(y) == len(rest_input(s, SHARE)) and np.ptp(u, axis=0).all()):
        raise CampaignError(f"{done[last]} is no record of a rest test of this session; restore it.")
    return rest_test(u, y, s)


def next_warnings(found: RestTest, s: Settings, whole: Array) -> list[str]:
    """What the rest test says of the input that comes next: whole (rows, nu)."""
    return _beyond(s, *_expected(found, s, whole), "halve it with `oed session next DIR --reduce`")
