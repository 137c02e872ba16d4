"""Stages of long work: who works says where it is, who waits listens; where nobody listens it costs nothing."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[str, int, int], object]
_LISTENER: ContextVar[Listener | None] = ContextVar("listener", default=None)


def stage(what: str, done: int = 0, total: int = 0) -> None:
    """Say what is being worked on, and of how many equal pieces how many are done; no total where nobody knows."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(what, done, total)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Hear the stages of the work inside; of work inside work, the outermost listener hears all."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)
