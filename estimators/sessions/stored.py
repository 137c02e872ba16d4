"""A session in a folder: the same session, whose inputs and outputs are files."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.sessions.checking import read_output, usable
from estimators.sessions.folder import KEPT, SETTINGS, Folder
from estimators.sessions.session import Asked, FlaggedMeasurement, Sequential
from estimators.sessions.settings import Settings, settings_from_json
from oed.errors import CampaignError, InputError
from oed.files.csv import csv_table
from oed.files.limits import file_content
from oed.files.tables import column_name
from oed.files.writing import write_whole

Array = NDArray[np.float64]
AGREE = 1e-9


def open_session(path: str | os.PathLike[str]) -> StoredSession:
    """Open a session where it stands, whatever happened to the process that worked on it.

    Parameters
    ----------
    path : str or path
        Its folder.

    Returns
    -------
    StoredSession
        The session.

    Raises
    ------
    CampaignError
        If there is no session, or its files are not those that it wrote.
    """
    return StoredSession(Path(path))


class StoredSession(Sequential):
    """A session whose state is a folder, its inputs and outputs files; several processes may take turns at it, one at a time.

    Parameters
    ----------
    path : Path
        Folder of a session that was started.
    """

    def __init__(self, path: Path) -> None:
        file = path / SETTINGS
        try:
            content = file_content(file)
            text = content.decode()
        except (OSError, UnicodeDecodeError):
            raise CampaignError(
                f"there is no session in {path} (no readable session.json); start one with `oed session start {path}`."
            ) from None
        self.path = path
        self.folder = Folder(path)
        settings = settings_from_json(text, str(file))
        self.folder.check_unchanged(file, content)
        self._play(settings)

    def _play(self, settings: Settings) -> None:
        """Begin anew with what is on record."""
        super().__init__(settings, self._known(settings))
        self._halved = 0
        self._refresh()

    def _known(self, s: Settings) -> list[Array]:
        """The inputs on record, where they are the method's own to the last bit."""
        altered = s.lead or s.ramp or any(s.level) or s.rate or s.energy
        inputs = self.folder.find("input")
        if s.method != "diagnose-next" or altered or any(version > 1 for _, version in inputs):
            return []
        return [read_signal(file, s.inputs)[: s.samples] for file in inputs.values()]

    @contextmanager
    def _up_to_date(self) -> Iterator[None]:
        with self.folder.alone():
            self._refresh()
            yield

    def _refresh(self) -> None:
        """Take in what the folder holds beyond what is known."""
        outputs, inputs = self.folder.find("output"), self.folder.find("input")
        steps = [step for step, _ in outputs]
        if steps != list(range(1, len(steps) + 1)):
            gap = next(k for k, step in enumerate([*steps, 0], start=1) if k != step)
            raise CampaignError(f"output-{gap:04d}.csv is missing from {self.path}; restore it.")
        for step in range(len(self.rig_records) + 1, len(steps) + 1):
            if self.step is None:
                raise CampaignError(
                    f"{outputs[step, 1]} is beyond the end of the session; it is of another session."
                )
            file = self._current_input(step, inputs)
            if file is None:
                raise CampaignError(
                    f"{self.folder.input_path(step).name} is missing from {self.path}; restore it."
                )
            self._check_input(file)
            content = file_content(outputs[step, 1])
            self.folder.check_unchanged(outputs[step, 1], content)
            y = read_signal(outputs[step, 1], self.settings.outputs)
            self._use(self.asked(), y)
        if self.step is not None:
            self._current_input(self.step, inputs)

    def _current_input(self, step: int, inputs: dict[tuple[int, int], Path] | None = None) -> Path | None:
        """The latest version of a step's input; the session is halved as often as the versions say."""
        inputs = self.folder.find("input") if inputs is None else inputs
        versions = [version for at, version in inputs if at == step]
        if not versions:
            return None
        if max(versions) > len(versions):
            gap = min(set(range(1, len(versions) + 1)) - set(versions))
            raise CampaignError(
                f"{self.folder.input_path(step, gap).name} is missing from {self.path}; restore it."
            )
        earlier = sum(1 for at, version in inputs if version > 1 and at < step)
        while self._halved < earlier + max(versions) - 1:
            self.reduce()
            self._halved += 1
        return inputs[step, max(versions)]

    def _check_input(self, file: Path) -> None:
        asked, content = self.asked(), file_content(file)
        if content == self._input_csv(asked):
            return
        self.folder.check_unchanged(file, content)
        u = read_signal(file, self.settings.inputs)
        size = np.abs(asked.whole).max()
        if u.shape != asked.whole.shape or np.abs(u - asked.whole).max() > AGREE * max(size, 1e-300):
            raise CampaignError(
                f"{file} is not the input that step {asked.step} of this session has; it is of another session or "
                "was written by another version: go on with the folder and version that wrote it."
            )

    def _input_csv(self, asked: Asked) -> bytes:
        return signal_csv(asked.whole, self.settings.inputs, self.settings.input_units, self.settings.dt)

    def next_input(self, *, reduce: bool = False) -> Path | None:
        """Write the next input, or find it written.

        Parameters
        ----------
        reduce : bool
            Halve it, and all that follow, after an output went beyond its abort level.

        Returns
        -------
        Path or None
            The file; None when the session is finished.

        Raises
        ------
        InputError
            If the input violates a limit or cannot be written.
        CampaignError
            If another process is at it, or the folder is damaged.
        """
        with self._up_to_date():
            step = self.step
            if step is None:
                return None
            written = self._current_input(step)
            if reduce:
                if written is None:
                    raise InputError(f"step {step} has no input yet that could be reduced; ask for it first.")
                self.reduce()
                self._halved += 1
            elif written is not None:
                self._check_input(written)
                return written
            asked = self.asked()
            version = 1 + sum(at == step for at, _ in self.folder.find("input"))
            file = write_whole(self.folder.input_path(step, version), self._input_csv(asked), kept=KEPT)
            words = f"{asked.kind}" + (f", times {asked.factor:.6g}: {asked.limit}" if asked.limit else "")
            self.folder.note(step, "input", file, words)
            return file

    def record(self, path: str | os.PathLike[str], *, accept: bool = False) -> tuple[int, Path]:
        """Check a recorded output and store it.

        Parameters
        ----------
        path : str or path
            What the rig wrote.
        accept : bool
            Whether to use it although it looks saturated or held.

        Returns
        -------
        step : int
            Which step it was the output of.
        file : Path
            Where it is stored.

        Raises
        ------
        InputError
            If it is not the output of the step that waits; nothing has changed.
        FlaggedMeasurement
            If it is unfit for use: it is kept as a flagged file, and the step waits for another measurement.
        """
        with self._up_to_date():
            done, step = len(self.rig_records), self.step
            waiting = step is not None and self._current_input(step) is not None
            reading = read_output(Path(path), self.settings, step if step and waiting else done)
            if not waiting and done and np.array_equal(reading.y, self.rig_records[-1].y):
                return done, self.folder.output_path(done)  # the same command once more
            if step is None:
                raise InputError(f"the session is finished after {done} experiments; it waits for no output.")
            if not waiting:
                raise InputError(
                    f"step {step} has no input yet, so this cannot be its output; ask for it with `oed session next`."
                )
            return step, self._store(step, reading.y, reading.u, accept)

    def undo(self) -> tuple[int, Path]:
        """Take the last output back, and the inputs that were made from it; all are kept aside.

        Returns
        -------
        step : int
            Which step waits again for its output.
        file : Path
            Where the output is kept.

        Raises
        ------
        InputError
            If nothing is recorded.
        """
        with self._up_to_date():
            done = len(self.rig_records)
            if not done:
                raise InputError("nothing is recorded yet, so that nothing can be taken back.")
            for (step, _), file in self.folder.find("input").items():
                if step > done:  # first: without them the session stands where it stood before it asked
                    self.folder.set_aside(step, file)
            aside = self.folder.set_aside(done, self.folder.output_path(done))
            self._play(self.settings)
            return done, aside

    def _store(self, step: int, y: Array, u: Array | None, accept: bool) -> Path:
        asked = self.asked()
        names, units = self.settings.outputs, self.settings.output_units
        if u is not None:
            names, units = (*self.settings.inputs, *names), (*self.settings.input_units, *units)
        stored = signal_csv(y if u is None else np.column_stack([u, y]), names, units, self.settings.dt)
        try:
            values = self._checked(y, u, accept)
        except FlaggedMeasurement as fault:
            flagged = [file for (at, _), file in self.folder.find("flagged").items() if at == step]
            if not any(file_content(file) == stored for file in flagged):
                name = f"flagged-{step:04d}-{len(flagged) + 1}.csv"
                self.folder.note(
                    step, "flagged", write_whole(self.path / name, stored, kept=KEPT), str(fault)
                )
            raise
        file = write_whole(self.folder.output_path(step), stored, kept=KEPT)
        self.folder.note(step, "output", file)
        self._use(asked, values)
        return file

    def ask(self) -> Array:
        """The input to apply next, as `Session.ask`; its file is written.

        Returns
        -------
        ndarray
            (rows, nu).
        """
        self.next_input()
        return self.asked().whole

    def tell(self, y: ArrayLike, u: ArrayLike | None = None, *, accept: bool = False) -> None:
        """Hand over the output, as `Session.tell`; it is stored.

        Parameters
        ----------
        y, u : array_like
            Output, and the input as it was recorded beside it.
        accept : bool
            Whether to use it although it looks saturated or held.
        """
        before = self.step
        with self._up_to_date():
            step = self.step
            if step is None or step != before:
                raise InputError(
                    f"step {before} was recorded meanwhile by another process; ask for the next input."
                )
            if self._current_input(step) is None:
                raise InputError(f"step {step} has no input yet; ask for it first.")
            rows = np.asarray(y, dtype=float)
            beside = None if u is None else np.asarray(u, dtype=float).reshape(len(rows), -1)
            self._store(step, rows[:, None] if rows.ndim == 1 else rows, beside, accept)

    def status(self) -> dict[str, Any]:
        """Where the session stands.

        Returns
        -------
        dict
            Method, step, the file of the input that waits, the last output stored, experiments, energy, flagged
            files, damage to the journal in words, and the status: READY (ask for the next input), WAITING (for an output), or how it ended.
        """
        step, done, usage = self.step, len(self.rig_records), self.trace.usage
        waiting = None if step is None else self._current_input(step)
        state = self.finished.name if self.finished else "WAITING" if waiting else "READY"
        return {
            "method": self.settings.method, "step": step, "input": None if waiting is None else str(waiting),
            "output": str(self.folder.output_path(done)) if done else None,
            "experiments": done, "budget": self.settings.experiments, "samples": usage.samples,
            "energy": usage.energy, "peak": usage.peak,
            "flagged": [str(file) for file in self.folder.find("flagged").values()],
            "status": state, "message": self.message, "damage": self.folder.damage(),
        }  # fmt: skip

    def __repr__(self) -> str:
        return f"{super().__repr__()} in {self.path}"


def signal_csv(signal: Array, names: tuple[str, ...], units: tuple[str, ...], dt: float) -> bytes:
    """A signal (rows, channels) as CSV with the time in seconds, every number with all its digits."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["t_s", *map(column_name, names, units)])
    t = np.arange(len(signal), dtype=float) * dt
    writer.writerows(np.column_stack([t, signal]).tolist())
    return stream.getvalue().encode()


def read_signal(file: Path, names: tuple[str, ...]) -> Array:
    """The last columns of a file that the session wrote: those of the channels named."""
    try:
        table = csv_table(file_content(file), file.name)
        signal = np.column_stack(table.load(table.names[-len(names) :]))
        if not usable(signal).all():
            raise InputError("it has samples that are not finite or too large")
        return signal
    except (InputError, ValueError) as error:
        raise CampaignError(f"{file} is damaged ({error}); restore it.") from None
