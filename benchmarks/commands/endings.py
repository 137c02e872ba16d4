"""What ends a command from outside: Ctrl-C, SIGTERM and SIGHUP, each once, whatever it comes upon."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from functools import partial
from typing import Any, NoReturn

ONCE_MORE = 0.05
"""Seconds until an interruption that was dropped comes again: any finaliser has ended by then."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C. The interpreter remembers a plain KeyboardInterrupt that left text given to `exec`, as a dataclass being made
    is, although it was caught later, and ends itself by the signal in the place of the exit status."""

    number = signal.SIGINT


class Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM: like Ctrl-C, but for the exit status."""

    number = signal.SIGTERM


class HungUp(Terminated):
    """Its terminal was closed, and nothing behind `nohup` said that it should go on."""

    number = getattr(signal, "SIGHUP", signal.SIGTERM)  # not on Windows


ENDING = {kind.number: kind for kind in (HungUp, Terminated, Interrupted)}


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """While the block runs, SIGTERM and SIGHUP end it as Ctrl-C does, so that workers end too and what was finished is kept. What
    is raised inside a finaliser or a callback of Python's own is dropped there, and asked for once more."""
    hook, asked = sys.unraisablehook, []

    def stop(number: int, frame: Any) -> NoReturn:
        threading.excepthook = partial(_of_threads, threading.excepthook)
        raise ENDING[signal.Signals(number)]

    def once_more(dropped: Any) -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            return hook(dropped)
        number = getattr(dropped.exc_type, "number", signal.SIGINT)
        asked.append(threading.Timer(ONCE_MORE, os.kill, (os.getpid(), number)))
        asked[-1].daemon = True
        return asked[-1].start()

    if threading.current_thread() is not threading.main_thread():  # whoever owns that decides
        yield
        return
    heard = [number for number in ENDING if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    before, sys.unraisablehook = {number: signal.signal(number, stop) for number in heard}, once_more
    try:
        yield
    finally:
        for timer in asked:
            timer.cancel()
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)


def _of_threads(hook: Any, failed: Any) -> None:
    """Silent on the thread that hands tasks to workers: once the command is ended, it finds those gone that it was about to hand on."""
    if failed.thread is None or failed.thread.name != "ExecutorManagerThread":
        hook(failed)


def leave_in_peace() -> None:
    """After the work: the interpreter, which still ends workers and tidies up, is not disturbed by the first signal of a kind, and
    says nothing of it; the second ends it."""
    if threading.current_thread() is threading.main_thread():
        for number in ENDING:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                signal.signal(number, lambda number, frame: signal.signal(number, signal.SIG_DFL))


def how(error: KeyboardInterrupt) -> str:
    """What ended the command, in words."""
    return "ended from outside" if isinstance(error, Terminated) else "interrupted"
