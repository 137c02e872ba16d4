"""A session begun in a folder: its settings written once, and never over another's."""

import os
from pathlib import Path

from estimators.sessions.folder import KEPT, README, SETTINGS, Folder
from estimators.sessions.session import Session
from estimators.sessions.settings import Settings, settings_from_json, settings_to_json
from estimators.sessions.stored import StoredSession
from oed.errors import CampaignError, InputError
from oed.files.limits import file_content
from oed.files.lock import locked
from oed.files.writing import write_whole


def start_session(path: str | os.PathLike[str], settings: Settings) -> StoredSession:
    """Start a session in a folder, or open it if it was started there with the same settings.

    Parameters
    ----------
    path : str or path
        The folder; it is made if it does not exist.
    settings : Settings
        Method, channels, lengths, limits.

    Returns
    -------
    StoredSession
        The session.

    Raises
    ------
    CampaignError
        If the folder holds another session or other files.
    InputError
        If it cannot be written.
    """
    folder = Path(path)
    Session(settings)  # whatever is wrong with the settings is said before anything is written
    text = settings_to_json(settings)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror or error}.") from None
    with locked(folder / "lock", f"the session {folder}"):
        file = folder / SETTINGS
        if file.exists():
            _check_same(file, text)
            return StoredSession(folder)
        ours = {"README.txt", "lock", "journal.txt"}
        foreign = sorted(e for e in os.listdir(folder) if e not in ours and not e.endswith(".tmp"))
        if foreign:
            raise CampaignError(
                f"the folder {folder} is not empty ({', '.join(foreign[:3])}...) and holds no session; "
                "start in a folder of its own."
            )
        write_whole(folder / "README.txt", README.encode(), kept=KEPT)
        write_whole(file, text.encode(), kept=KEPT)
        Folder(folder).note(0, "settings", file)
    return StoredSession(folder)


def _check_same(file: Path, text: str) -> None:
    was, now = settings_from_json(file_content(file).decode(), str(file)), settings_from_json(text, "")
    differ = [name for name in was.__dataclass_fields__ if getattr(was, name) != getattr(now, name)]
    if differ:
        listed = (
            ", ".join(f"{name} {getattr(was, name)!r}" for name in differ if name != "model") or "its model"
        )
        raise CampaignError(
            f"the folder {file.parent} holds another session ({listed}); go on with its settings, or start in another "
            "folder."
        )
