"""Experiments on a rig: a sequential method that waits for its measurements, by Python or by files.

    from estimators.sessions import Session, Settings
    session = Session(Settings("power", samples=1000, dt=0.001, amplitude=(2.0,)))
    while session.step:
        session.tell(my_rig(session.ask()))
    session.estimate()

`start_session(folder, settings)` and `open_session(folder)` give the same, with every input and output a file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimators.sessions.missing import what_is_missing
    from estimators.sessions.session import FlaggedMeasurement, Session
    from estimators.sessions.settings import Settings
    from estimators.sessions.stored import StoredSession, open_session, start_session

_HOME = {
    "FlaggedMeasurement": "estimators.sessions.session",
    "Session": "estimators.sessions.session",
    "Settings": "estimators.sessions.settings",
    "StoredSession": "estimators.sessions.stored",
    "open_session": "estimators.sessions.stored",
    "start_session": "estimators.sessions.stored",
    "what_is_missing": "estimators.sessions.missing",
}

__all__ = [
    "FlaggedMeasurement",
    "Session",
    "Settings",
    "StoredSession",
    "open_session",
    "start_session",
    "what_is_missing",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
