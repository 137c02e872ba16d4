"""The files of a session: whole or not at all, added and never changed, readable by a person.

    session.json          the settings, written once
    README.txt            what the files are
    input-0007.csv        what the rig is to apply in step 7; input-0007-2.csv the same at half the size, and so on
    output-0007.csv       what was measured, as it is used
    flagged-0007-1.csv    a measurement that was not used
    rest-input-0001.csv   the input of a rest test, and rest-output-0001.csv what it gave
    journal.txt           one line per event: time, step, file, fingerprint

The state is `session.json` and the inputs and outputs; the journal adds their fingerprints and is mended where a kill
came between a file and its line."""

import hashlib
import itertools
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from oed.errors import CampaignError
from oed.files.limits import file_content
from oed.files.lock import locked
from oed.files.writing import append_line, renamed, tidy, write_whole

NAME = re.compile(r"(input|output|flagged|rest-input|rest-output)-(\d{4,})(?:-(\d+))?\.csv")
SETTINGS, JOURNAL = "session.json", "journal.txt"
UNDONE = re.compile(r"undone-((?:input|output)-(\d{4,})(?:-\d+)?)-\d+\.csv")
LINE = re.compile(r"\d{4}(?:-\d\d){2}T\d\d(?::\d\d){2}Z \d{4,} ([a-z-]+) (\S+) ([0-9a-f]{16})(?: (.*))?")
"""Of the journal: event, file, fingerprint, words."""
KINDS = ("input", "output", "flagged", "rest-input", "rest-output")
KEPT = "The session is unharmed; make room and repeat."
README = """A session of experiments on a rig. To go on, in this folder's parent:

  oed session rest DIR                 writes rest-input-NNNN.csv: the input at rest, then a small pulse; then
  oed session rest DIR output.csv      says noise, drift, gain and delay of the rig, and warns
  oed session next DIR                 writes the next input-NNNN.csv (time in seconds, one column per input)
  oed session record DIR output.csv    stores what was measured (columns: the outputs' names, one row per input row;
                                       with the inputs' names too, they are compared with what was asked for)
  oed session undo DIR                 takes the last output back; its file is kept aside as undone-output-NNNN-1.csv
  oed session status DIR               where the session stands
  oed session estimate DIR             the estimate so far with its uncertainty

Every file here is written once and never changed. Every command can be repeated.
"""


class Folder:
    """The folder of a session."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def find(self, kind: str) -> dict[tuple[int, int], Path]:
        """The files of a kind by step and version: returns (step, version)."""
        found = {}
        for entry in os.listdir(self.path):
            hit = NAME.fullmatch(entry)
            if hit and hit[1] == kind:
                found[int(hit[2]), int(hit[3] or 1)] = self.path / entry
        return dict(sorted(found.items()))

    def input_path(self, step: int, version: int = 1) -> Path:
        """Name of an input file."""
        return self.path / (f"input-{step:04d}" + (f"-{version}" if version > 1 else "") + ".csv")

    def output_path(self, step: int) -> Path:
        """Name of an output file."""
        return self.path / f"output-{step:04d}.csv"

    @contextmanager
    def alone(self) -> Iterator[None]:
        """No other process works here meanwhile; what a killed one left half written, or not yet in the journal, is mended."""
        with locked(self.path / "lock", f"the session {self.path}"):
            tidy(self.path)
            self._end_journal()
            known = self.fingerprints()
            if SETTINGS not in known:
                self.note(0, "settings", self.path / SETTINGS)
            for kind in KINDS:
                for (step, _), file in self.find(kind).items():
                    if file.name not in known:
                        self.note(step, kind, file)
            for hit in filter(None, map(UNDONE.fullmatch, sorted(os.listdir(self.path)))):
                if (
                    hit[0] not in known
                ):  # else the name's next file would be held against this one's fingerprint
                    self.note(int(hit[2]), "undone", self.path / hit[0], f"{hit[1]}.csv")
            yield

    def note(self, step: int, event: str, file: Path, words: str = "") -> None:
        """Add a line to the journal."""
        stamp = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        about = f"{file.name} {fingerprint(file_content(file))}"
        append_line(
            self.path / JOURNAL,
            " ".join([stamp, f"{step:04d}", event, about, *words.split()]),
            kept=KEPT,
        )

    def set_aside(self, step: int, file: Path) -> Path:
        """Rename a file so that it is no longer of the session; the journal says so, and forgets its fingerprint."""
        names = (self.path / f"undone-{file.stem}-{k}.csv" for k in itertools.count(1))
        aside = next(name for name in names if not name.exists())
        renamed(file, aside, kept=KEPT)
        self.note(step, "undone", aside, file.name)
        return aside

    def fingerprints(self) -> dict[str, str]:
        """What the journal says of each file."""
        found: dict[str, str] = {}
        for entry in filter(None, map(_entry, self._journal())):
            event, name, mark, words = entry.groups()
            found[name] = mark
            if event == "undone":
                found.pop(words, None)
        return found

    def _journal(self) -> list[str]:
        """Its lines, the last one what stands behind the last end of a line: nothing, or what a kill left of a line."""
        journal = self.path / JOURNAL
        return file_content(journal).decode(errors="replace").split("\n") if journal.is_file() else [""]

    def _end_journal(self) -> None:
        """Cut off what a kill left of the last line: the file that it was about is noted again."""
        *lines, last = self._journal()
        if last and not _entry(last):
            write_whole(self.path / JOURNAL, "".join(f"{line}\n" for line in lines), kept=KEPT)

    def damage(self) -> list[str]:
        """What is lost by lines of the journal that cannot be read, a sentence each."""
        return [
            f"Line {number} of {self.path / JOURNAL} is damaged: the fingerprint in it is lost, so that a change made to its "
            f"file before now would not be noticed. It reads {line[:80]!r}."
            for number, line in enumerate(self._journal()[:-1], 1)
            if not _entry(line)
        ]

    def check_unchanged(self, file: Path, content: bytes) -> None:
        """Raise if a file is not what the journal says it was."""
        known = self.fingerprints().get(file.name)
        if known is not None and known != fingerprint(content):
            raise CampaignError(
                f"{file} was changed after the session wrote it; restore it (its fingerprint in journal.txt is {known}), "
                "or start another session."
            )


def _entry(line: str) -> re.Match[str] | None:
    """A line of the journal in its parts; None where it is not one that was written here."""
    entry = LINE.fullmatch(line)
    if entry is None or entry.group(1, 2) == ("settings", SETTINGS):
        return entry
    undone = entry[1] == "undone"
    named = NAME.fullmatch((entry[4] or "") if undone else entry[2])
    return entry if named and (undone or named[1] == entry[1]) else None


def fingerprint(content: bytes) -> str:
    """Short checksum of a file's content."""
    return hashlib.sha256(content).hexdigest()[:16]
