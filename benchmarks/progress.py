"""What a command that takes long says on standard error: stage, elapsed, and what remains where the work is known."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from estimators.stages import listening

QUIET = 2.0
"""Seconds after which a command shows that it is at work."""
BEAT = 0.5
"""Seconds between looks at the clock: a person sees the line move."""


class _Line:
    """The stage of a command, and how long it takes. On a terminal one line that is written anew; elsewhere a
    line for each stage that begins, or is reached, after `QUIET` seconds."""

    def __init__(self, command: str, stream: TextIO, now: Callable[[], float]) -> None:
        self.command, self.stream, self.now = command, stream, now
        self.begin = now()
        self.what, self.done, self.total, self.since, self.counted = "", 0, 0, self.begin, 0
        self.said = ""
        self.terminal = stream.isatty()
        self.shown = False

    def hear(self, what: str, done: int, total: int) -> None:
        """A stage, from the work."""
        if what != self.what or total != self.total or done < self.done:
            self.since, self.counted = self.now(), done
        self.what, self.done, self.total = what, done, total

    def text(self) -> str:
        """Elapsed, stage, how many of how many, and what remains at the pace of this stage."""
        now = self.now()
        words = [f"oed {self.command}: {in_words(now - self.begin)}"]
        if self.what:
            words.append(self.what + (f" ({self.done} of {self.total})" if self.total else ""))
        pieces = self.done - self.counted
        if self.total and pieces > 0:
            left = (now - self.since) / pieces * (self.total - self.done)
            words.append(f"about {in_words(left)} left in this stage")
        return ", ".join(words)

    def look(self) -> None:
        """Write what there is to say, after `QUIET` seconds."""
        if self.now() - self.begin < QUIET:
            return
        if self.terminal:
            self.stream.write(f"\r\033[K{self.text()}")
        elif self.what and self.said != self.what:
            self.said = self.what
            self.stream.write(self.text() + "\n")
        self.shown = True
        self.stream.flush()

    def clear(self) -> None:
        """Take the line off a terminal."""
        if self.terminal and self.shown:
            self.stream.write("\r\033[K")
            self.stream.flush()


def in_words(seconds: float) -> str:
    """Seconds as a person says them."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.3g} s" if seconds < 10 else f"{whole} s"
    minutes = f"{whole // 60 % 60} min"
    return f"{minutes} {whole % 60} s" if whole < 3600 else f"{whole // 3600} h {minutes}"


def drawn() -> TextIO:
    """Standard error for what moves the cursor, which in all other text is written out."""
    return getattr(sys.stderr, "drawn", sys.stderr)


@contextmanager
def shown(command: str, stream: TextIO | None = None) -> Iterator[None]:
    """While the block runs, its stages and its time on a stream, standard error as it is now if none is given."""
    line = _Line(command, drawn() if stream is None else stream, time.monotonic)
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(BEAT):
            line.look()

    thread = threading.Thread(target=tell, daemon=True)
    thread.start()
    try:
        with listening(line.hear):
            yield
    finally:
        ended.set()
        thread.join()
        line.clear()
