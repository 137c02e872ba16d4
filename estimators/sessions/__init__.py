"""Experiments on a rig: a sequential method that waits for its measurements, by Python or by files.

    from estimators.sessions import Session, Settings
    session = Session(Settings("power", samples=1000, dt=0.001, amplitude=(2.0,)))
    while session.step:
        session.tell(my_rig(session.ask()))
    session.estimate()

`start_session(folder, settings)` and `open_session(folder)` give the same, with every input and output a file.
"""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from estimators.sessions.missing import what_is_missing
    from estimators.sessions.session import FlaggedMeasurement, Session
    from estimators.sessions.settings import Settings
    from estimators.sessions.starting import start_session
    from estimators.sessions.stored import StoredSession, open_session

__all__ = [
    "FlaggedMeasurement", "Session", "Settings", "StoredSession", "open_session", "start_session",
    "what_is_missing",
]  # fmt: skip

__getattr__, __dir__ = exporting(__name__)
