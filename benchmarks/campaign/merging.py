"""Stores put together: machines that each ran some plants, noise levels, inputs or replicates of one campaign."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.campaign.settings import Limit
from benchmarks.campaign.store import CONTENTS, KEPT, UNITED, Store, versions
from oed.errors import CampaignError, InputError
from oed.files.limits import file_content
from oed.files.writing import write_whole


def merge_stores(folders: Sequence[Path], out: Path) -> dict[str, Any]:
    """Copy the finished parts of several stores into one."""
    if not folders:
        raise InputError("no folders to merge; give at least one.")
    found = [_description(folder) for folder in folders]
    base = found[0]
    for folder, other in zip(folders, found, strict=True):
        if other["versions"] != versions():
            raise CampaignError(
                f"{folder} was written with other versions and is not mixed. Nothing was written."
            )
        different = [
            name
            for name in base["settings"]
            if name not in (*UNITED, "contents") and other["settings"].get(name) != base["settings"][name]
        ]
        if different:
            raise CampaignError(
                f"{folder} and {folders[0]} have different {', '.join(different)}; only plants, noise variances and methods "
                "may differ. Nothing was written."
            )
    settings = dict(base["settings"])
    files: dict[str, str] = {}
    for folder, other in zip(folders, found, strict=True):
        for name, digest in other["settings"].get("contents", ()):
            if files.setdefault(name, digest) != digest:
                raise CampaignError(
                    f"the plant file {name} of {folder} had another content than that of the folders before it. "
                    "Nothing was written."
                )
    settings["contents"] = [[name, files[name]] for name in files]
    for name in UNITED:
        settings[name] = list(dict.fromkeys(v for other in found for v in other["settings"][name]))
    if settings.get("sources"):
        raise CampaignError(
            "stores with one's own methods are not merged: their code is not in the store. Nothing was written."
        )
    store = Store(out, settings)
    replicates = 2
    for folder in folders:
        for path in sorted((folder / "parts").glob("*.parquet")):
            replicates = max(replicates, int(path.stem.rpartition("-")[2]))
            if store.path(path.stem).exists() or path.resolve() == store.path(path.stem).resolve():
                continue
            try:
                content = file_content(path)
            except OSError as error:
                raise CampaignError(
                    f"cannot read {path} ({error.strerror}); what was copied is kept."
                ) from None
            write_whole(store.path(path.stem), content, kept=KEPT, error=CampaignError)
    for name in CONTENTS:
        settings.pop(name, None)
    limits = tuple(Limit(**entry) for entry in settings.pop("limits", []))
    return settings | {"limits": limits, "replicates": replicates, "out": str(out)}


def _description(folder: Path) -> dict[str, Any]:
    try:
        content = json.loads(file_content(folder / "campaign.json"))
        return {"settings": dict(content["settings"]), "versions": content["versions"]}
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            f"{folder} holds no readable campaign.json; give the --out folders of comparisons."
        ) from None
