"""A time limit for a call, whatever the call does: on any thread, in any worker."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

from oed.errors import InputError


class TimeLimit(Exception):
    """The call had not returned in time."""


class _Stop(BaseException):
    """Raised inside a call that is given up; not an Exception, so that the call does not catch it."""


def within(seconds: float | None, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Call a function and wait for it no longer than a time limit. The call runs on a thread of its own. A
    call that is given up is interrupted at its next step of Python; inside compiled code it goes on unheard
    until it returns, and ends with the process at the latest."""
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
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident or 0), ctypes.py_object(_Stop))
        raise TimeLimit(f"stopped after {seconds:g} s")
    if "error" in outcome:
        raise outcome["error"]
    return outcome["value"]
