"""The folder of a campaign: its settings, and one Parquet file per finished part.

A part is written under a temporary name and renamed, so that what is there is whole; a part that cannot be
read is named and run again. The settings file ties the folder to one campaign.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from oed.errors import CampaignError
from oed.files.parquet import open_parquet, read_columns, table_bytes

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["Store", "made_by", "versions"]

PACKAGES = ("numpy", "scipy", "casadi", "cvxpy", "clarabel", "control", "numba", "oed")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the numbers.

    Returns
    -------
    dict
        Name to version.
    """
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def made_by() -> dict[str, Any]:
    """Versions and machine, as kept beside every result.

    Returns
    -------
    dict
        versions, machine, system.
    """
    return {"versions": versions(), "machine": platform.machine(), "system": sys.platform}


def write_atomically(path: Path, text: str) -> None:
    """Write a text file so that a reader sees the old one or the whole new one.

    Parameters
    ----------
    path : Path
        Where to.
    text : str
        Content.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise CampaignError(
            f"cannot write {path} ({error.strerror}); what was there before is kept: make room or choose another --out."
        ) from None


class Store:
    """The results of one campaign on disk.

    Parameters
    ----------
    folder : Path
        Created if absent.
    settings : mapping
        What decides the numbers (not the number of replicates, nor of workers).
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        self.parts = folder / "parts"
        wanted = json.loads(json.dumps(settings))
        file = folder / "campaign.json"
        if folder.is_dir() and any(folder.iterdir()):
            found = self._settings_of(file)
            if found["settings"] != wanted:
                raise CampaignError(
                    f"{folder} holds a campaign with other settings ({_difference(found['settings'], wanted)}); "
                    "give another --out, or the same settings to resume it. Nothing was written."
                )
            if found["versions"] != versions():
                raise CampaignError(
                    f"{folder} was written with other versions ({_difference(found['versions'], versions())}), and "
                    "numbers of two versions are not mixed; give another --out. Nothing was written."
                )
        try:
            self.parts.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CampaignError(
                f"cannot create {self.parts}: {error.strerror}; choose another --out."
            ) from None
        if not file.exists():
            content = {"settings": wanted, **made_by()}
            write_atomically(file, json.dumps(content, indent=1) + "\n")
        self.metadata = {b"oed.campaign": json.dumps({"settings": wanted, **made_by()}).encode()}

    @staticmethod
    def _settings_of(file: Path) -> dict[str, Any]:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            return {"settings": content["settings"], "versions": content["versions"]}
        except (OSError, ValueError, KeyError, TypeError):
            raise CampaignError(
                f"{file.parent} is not empty and holds no readable campaign.json; give a new or empty folder as --out. "
                "Nothing was written."
            ) from None

    def path(self, key: str) -> Path:
        """File of a part.

        Parameters
        ----------
        key : str
            Name of the part.

        Returns
        -------
        Path
            Whether it exists or not.
        """
        return self.parts / f"{key}.parquet"

    def read(self, key: str) -> pa.Table | None:
        """Columns of a finished part; None where it is absent or damaged.

        Parameters
        ----------
        key : str
            Name of the part.

        Returns
        -------
        pyarrow.Table, or None
            One row per estimate, and per checkpoint.
        """
        import pyarrow as pa

        path = self.path(key)
        if not path.exists():
            return None
        try:
            return read_columns(open_parquet(path.read_bytes()))
        except (OSError, pa.ArrowException):
            print(f"{path} is damaged and is computed again.", file=sys.stderr)
            return None

    def holds(self, key: str) -> bool:
        """Whether a part is there and its end can be read; a part cut short says so.

        Parameters
        ----------
        key : str
            Name of the part.

        Returns
        -------
        bool
            From the end of the file, without reading the rows.
        """
        import pyarrow as pa

        path = self.path(key)
        if not path.exists():
            return False
        try:
            with open_parquet(path) as file:
                return file.metadata.num_rows > 0
        except (OSError, pa.ArrowException):
            print(f"{path} is damaged and is computed again.", file=sys.stderr)
            return False

    def write(self, key: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Keep the rows of a part.

        Parameters
        ----------
        key : str
            Name of the part.
        rows : iterable of mapping
            Its rows.
        """
        import pyarrow as pa

        path = self.path(key)
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            table = pa.Table.from_pylist(list(rows)).replace_schema_metadata(self.metadata)
            temporary.write_bytes(table_bytes(table))
            os.replace(temporary, path)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            reason = error.strerror or str(error).strip() or type(error).__name__
            raise CampaignError(
                f"cannot write {path} ({reason}); what was finished before is kept: make room and run again."
            ) from None


def _difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    names = sorted(set(found) | set(wanted))
    return ", ".join(
        f"{name}: there {found.get(name)}, asked {wanted.get(name)}"
        for name in names
        if found.get(name) != wanted.get(name)
    )
