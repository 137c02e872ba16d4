"""The folder of a campaign: its settings, and one Parquet file per finished part.

A part is bound to what made it: it carries its own name, the settings, the digests of every input, the versions and
a digest of its values. What is cut short, damaged, or made by anything else is named and run again."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterable, Mapping
from functools import lru_cache
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import oed
from oed.errors import CampaignError, Status
from oed.files.limits import file_content
from oed.files.parquet import open_parquet, read_columns, table_bytes
from oed.files.writing import tidy, write_whole

if TYPE_CHECKING:
    import pyarrow as pa

PACKAGES = ("numpy", "scipy", "casadi", "cvxpy", "clarabel", "control", "numba", "oed")
MADE = b"oed.campaign"
UNITED = ("plants", "noise_variances", "methods")
"""What stores that are merged may differ in: a part is of one of each, and its name says which."""
CONTENTS = ("contents", "sources")
"""Digests by name, of plant files and of one's own methods: stores agree on what both have."""
KEPT = "What was finished before is kept: make room and run again."
DECIDING = ("oed", "estimators", "benchmarks/campaign")
"""Folders whose source decides the stored numbers; the rest, and files named `plots`, only shows them."""


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Digest of the source that decides the numbers, as it is on the disk of this machine."""
    found = blake2b(digest_size=8)
    root = Path(oed.__file__).parent.parent
    for folder in DECIDING:
        for path in sorted((root / folder).rglob("*.py")):
            if path.stem != "plots":
                name = path.relative_to(root).as_posix()
                found.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # one of an extra that a comparison does without
        return "not installed"


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{name: _version(name) for name in PACKAGES},
        "source": source_digest(),
    }


def versions() -> dict[str, str]:
    """Versions of Python, of the packages that decide the numbers, and the digest of our own source."""
    return dict(_versions())


def made_by() -> dict[str, Any]:
    """Versions and machine, as kept beside every result."""
    return {"versions": versions(), "machine": platform.machine(), "system": sys.platform}


class Store:
    """The results of one campaign on disk; `settings` is what decides the numbers (not how many replicates or workers)."""

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        self.parts = folder / "parts"
        self.settings = json.loads(json.dumps(settings))
        file = folder / "campaign.json"
        if folder.is_dir() and not all(map(_left_by_a_start, folder.iterdir())):
            found = self._settings_of(file)
            if found["settings"] != self.settings:
                raise CampaignError(
                    f"{folder} holds a campaign with other settings ({difference(found['settings'], self.settings)}); "
                    "give another --out, or the same settings to resume it. Nothing was written."
                )
            if found["versions"] != versions():
                raise CampaignError(
                    f"{folder} was written with other versions ({difference(found['versions'], versions())}), and "
                    "numbers of two versions are not mixed; give another --out. Nothing was written."
                )
        try:
            self.parts.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CampaignError(
                f"cannot create {self.parts}: {error.strerror}; choose another --out."
            ) from None
        if not file.exists():
            text = json.dumps({"settings": self.settings, **made_by()}, indent=1)
            write_whole(file, text + "\n", error=CampaignError)

    @staticmethod
    def _settings_of(file: Path) -> dict[str, Any]:
        try:
            content = json.loads(file_content(file))
            found = {"settings": dict(content["settings"]), "versions": dict(content["versions"])}
            # Pairs of names and digests, as `difference` takes them: what is none is refused here.
            for name in CONTENTS:
                dict(found["settings"].get(name, ()))
            return found
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            raise CampaignError(
                f"{file.parent} is not empty and holds no readable campaign.json; give a new or empty folder as --out. "
                "Nothing was written."
            ) from None

    def tidy(self) -> None:
        """Remove what killed processes left half written; the caller holds the folder's lock."""
        tidy(self.folder)

    def path(self, key: str) -> Path:
        """File of a part, whether it exists or not."""
        return self.parts / f"{key}.parquet"

    def read(self, key: str) -> pa.Table | None:
        """Columns of a finished part, one row per estimate and per checkpoint; None where it cannot be believed."""
        return self._checked(key, values=True)

    def holds(self, key: str, time_limit: float | None = 0.0) -> bool:
        """Whether a part is there, by its end, without reading the rows. One with runs that were given up
        after less than `time_limit` (None: no limit) is to be tried again."""
        made = self._checked(key, values=False)
        if made is None:
            return False
        allowed = float("inf") if time_limit is None else time_limit
        if made["given_up"] and allowed > made["time_limit"]:
            print(
                f"{self.path(key).name}: {made['given_up']} results were given up after {made['time_limit']:g} s and are "
                "tried again with more time.",
                file=sys.stderr,
            )
            return False
        return True

    def _checked(self, key: str, values: bool) -> Any:
        """The rows, or what made them; None, with the reason on standard error, where it is not this campaign's part."""
        import pyarrow as pa

        path = self.path(key)
        if not path.exists():
            return None
        try:
            with open_parquet(path) as file:
                made = json.loads(file.schema_arrow.metadata[MADE])
                allowed = made["time_limit"]
                made["time_limit"] = float("inf") if allowed is None else float(allowed)
                made["given_up"] = int(made["given_up"])
                why = self._foreign(made, key) or ("" if file.metadata.num_rows else "is empty")
                result = made
                if values and not why:
                    result = read_columns(file)
                    why = "" if _digest(result) == made["digest"] else "is damaged"
        except (OSError, pa.ArrowException, ValueError, KeyError, TypeError, RecursionError):
            why = "is damaged"
        if why:
            print(f"{path} {why} and is computed again.", file=sys.stderr)
            return None
        return result

    def _foreign(self, made: Mapping[str, Any], key: str) -> str:
        """Why a part is not of this campaign; empty where it is."""
        if made["key"] != key:
            return f"is the part {made['key']} of a campaign"
        found, wanted = dict(made["settings"]), dict(self.settings)
        for name in CONTENTS:
            theirs, ours = dict(found.get(name, ())), dict(wanted.get(name, ()))
            common = set(theirs) & set(ours)
            found[name], wanted[name] = ([sorted((n, d[n]) for n in common)] for d in (theirs, ours))
        for name in UNITED:
            found[name] = wanted[name]
        if found != wanted:
            return f"is of another campaign ({difference(found, wanted)})"
        if made["versions"] != versions():
            return f"was made by other versions ({difference(made['versions'], versions())})"
        return ""

    def write(
        self, key: str, rows: pa.Table | Iterable[Mapping[str, Any]], time_limit: float | None = None
    ) -> None:
        """Keep the rows of a part, whose runs had so many seconds."""
        import pyarrow as pa
        import pyarrow.compute as pc

        table: Any = rows if isinstance(rows, pa.Table) else pa.Table.from_pylist(list(rows))
        given_up = pc.sum(pc.equal(table["status"], Status.TIME_LIMIT.name)).as_py() or 0
        # The digest is of what a reader will get, so it is read once before it is kept.
        read_back = read_columns(open_parquet(table_bytes(table.replace_schema_metadata(None))))
        made = {"key": key, "settings": self.settings, **made_by(), "digest": _digest(read_back)}
        made |= {"time_limit": time_limit, "given_up": int(given_up)}
        content = table_bytes(table.replace_schema_metadata({MADE: json.dumps(made).encode()}))
        write_whole(self.path(key), content, kept=KEPT, error=CampaignError)


def _left_by_a_start(entry: Path) -> bool:
    """Whether a run that was killed before its campaign.json was there may have left this."""
    return (
        entry.name == "lock"
        or entry.match(".*.tmp")
        or (entry.name == "parts" and entry.is_dir() and not any(entry.iterdir()))
    )


def _digest(table: pa.Table) -> str:
    """Digest of names, types and values, however the rows are cut into pieces."""
    import pyarrow as pa

    sink = pa.BufferOutputStream()
    plain = table.replace_schema_metadata(None).combine_chunks()
    with pa.ipc.new_stream(sink, plain.schema) as stream:
        stream.write_table(plain)
    return blake2b(sink.getvalue(), digest_size=16).hexdigest()


def difference(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    """What two settings differ in, in words."""
    names = sorted(set(found) | set(wanted))
    return ", ".join(
        f"an older version wrote it, without {name}"
        if name in CONTENTS and name not in found
        else f"the content of {_changed(found.get(name), wanted.get(name))}"
        if name in CONTENTS
        else f"{name}: there {found.get(name)}, asked {wanted.get(name)}"
        for name in names
        if found.get(name) != wanted.get(name)
    )


def _changed(found: Any, wanted: Any) -> str:
    pairs = {tuple(map(str, pair)) for pair in found or ()} ^ {tuple(map(str, pair)) for pair in wanted or ()}
    return " and ".join(sorted({pair[0] for pair in pairs}))
