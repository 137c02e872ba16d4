"""A time limit for a call, whatever the call does: on any thread, in any worker."""

import ctypes
import sys
import threading
from collections.abc import Callable
from typing import Any

from oed.errors import InputError

UNBROKEN = {
    "importlib", "_frozen_importlib", "_frozen_importlib_external", "numba", "threading", "warnings",
    "logging",
}  # fmt: skip
"""Packages whose work is shared by all threads: broken off, an import stays half done and Numba's compiler locked."""
LOOK, AGAIN, WAIT = 0.01, 1.0, 2.0
"""Seconds between two looks at whether a call may be interrupted; until it is interrupted again, as `__del__` takes no
notice; and for which the caller waits until it has ended, since what it leaves running would slow the next."""


class TimeLimit(Exception):
    """The call had not returned in time."""


class _Stop(BaseException):
    """Raised inside a call that is given up; not an Exception, so that the call does not catch it."""


def within(seconds: float | None, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Call a function and wait for it no longer than a time limit. The call runs on a thread of its own. A
    call that is given up is interrupted at its next step of Python that no other thread depends on, which is
    waited for a little; inside compiled code it goes on unheard until it returns, and ends with the process at
    the latest."""
    if seconds is None:
        return work(*args, **options)
    if not seconds > 0:
        raise InputError(f"the time limit is {seconds:g} s; it must be positive.")
    outcome: dict[str, Any] = {}

    def body() -> None:
        try:
            outcome["value"] = work(*args, **options)
        except _Stop:
            return
        except BaseException as error:  # passed on to the caller, whatever it is
            outcome["error"] = error

    thread = threading.Thread(target=body, daemon=True, name="time-limited")
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        end = threading.Thread(target=_end, args=(thread,), daemon=True, name="time-limit")
        end.start()
        end.join(WAIT)
        raise TimeLimit(f"stopped after {seconds:g} s")
    if "error" in outcome:
        raise outcome["error"]
    return outcome["value"]


def _end(thread: threading.Thread) -> None:
    """Interrupt a thread wherever nothing of others is broken off, until it has ended. Between look and interruption
    it does not run: whoever has just been waiting keeps the interpreter for longer than both take."""
    while thread.is_alive():
        ident = thread.ident or 0
        free = not _shared(ident)
        if free:
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(ident), ctypes.py_object(_Stop))
        thread.join(AGAIN if free else LOOK)


def _shared(ident: int) -> bool:
    """Whether a thread is in the middle of what others depend on."""
    frame, names = sys._current_frames().get(ident), set()
    # from there on it is the thread's own beginning
    while frame is not None and frame.f_globals is not globals():
        names.add(frame.f_globals.get("__name__", "").partition(".")[0])
        frame = frame.f_back
    return bool(names & UNBROKEN)
