"""One process at a time in a folder: a lock that the system releases when its process dies."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from oed.errors import CampaignError, InputError
from oed.files.limits import own_file


@contextlib.contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Hold the lock on `what` (words for the message) while the block runs; refuse where another process
    holds it. The lock is the operating system's, on the file at `path`, and not the file's existence: when a
    process is killed the system lets go, so that nothing stale is left to be removed."""
    try:
        file = own_file(path).open("a+b")
    except OSError as error:
        raise InputError(f"{what} cannot be written to: {error.strerror or error}.") from None
    with file:
        try:
            _take(file)
        except OSError:
            file.seek(0)
            holder = file.read(100).decode(errors="replace").strip()
            by = f" (process {holder})" if holder else ""
            raise CampaignError(
                f"another process{by} is working in {what}; wait until it has finished, and try again. "
                "Nothing was changed."
            ) from None
        # who holds it is a courtesy for the message above: a full disk must not stand in the way
        with contextlib.suppress(OSError):
            file.seek(0)
            file.truncate()
            file.write(str(os.getpid()).encode())
            file.flush()
        yield


def _take(file: IO[bytes]) -> None:
    if sys.platform == "win32":
        import msvcrt

        file.seek(2**30)  # beyond the content, which stays readable
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
