"""Plants from and to JSON: the files that `oed --plant FILE.json` reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from oed.errors import InputError
from oed.plants.plant import Plant

__all__ = ["plant_from_json", "plant_to_json"]


def plant_from_json(source: str | Path | Mapping[str, Any], *, noise_variance: float | None = None) -> Plant:
    """Read a plant from a JSON file or an already parsed mapping.

    Parameters
    ----------
    source : str, Path or mapping
        A file with `num`, `den`, `dt` (or `A`, `B`, `C`, `D`, `dt`), optionally `noise` and `free`.
    noise_variance : float, optional
        Overrides the variance in the file.

    Returns
    -------
    Plant
        The plant; InputError if the file is not such a description.
    """
    if isinstance(source, Mapping):
        content, where, name = dict(source), "the plant", "plant"
    else:
        where, name = str(source), Path(source).stem
        try:
            content = json.loads(Path(source).read_text())
        except OSError as error:
            raise InputError(f"cannot read the plant file {source}: {error.strerror}.") from None
        except json.JSONDecodeError as error:
            raise InputError(f"{source} is not JSON (line {error.lineno}: {error.msg}).") from None
    if not isinstance(content, dict):
        raise InputError(
            f"{where} holds {type(content).__name__}; a plant is a JSON object with num, den and dt."
        )
    known = {"num", "den", "A", "B", "C", "D", "dt", "noise", "free", "name", "schema_version"}
    extra = sorted(set(content) - known)
    if extra:
        raise InputError(f"{where} has the unknown keys {extra}; a plant has {sorted(known)}.")
    noise = content.get("noise", {})
    attributes: dict[str, Any] = {"name": content.get("name", name), "free": tuple(content.get("free", ()))}
    if "covariance" in noise or "variance" in noise:
        attributes["noise_covariance"] = noise.get("covariance", noise.get("variance"))
    if "filter" in noise:
        attributes["noise_num"], attributes["noise_den"] = noise["filter"]["num"], noise["filter"]["den"]
    if noise_variance is not None:
        attributes["noise_covariance"] = noise_variance
    dt = content.get("dt", 1.0)
    if dt in (0, 0.0):
        raise InputError(
            f"{where} has dt = 0, a continuous-time plant; sample it first with a sampling time and a hold, "
            'for example Plant.from_control(system, dt=0.01, hold="zoh").'
        )
    if {"A", "B", "C"} <= set(content):
        from oed.plants.realisations import from_state_space

        D = content.get(
            "D", np.zeros((np.atleast_2d(content["C"]).shape[0], np.atleast_2d(content["B"]).shape[1]))
        )
        return from_state_space(content["A"], content["B"], content["C"], D, dt=dt, **attributes)
    if not {"num", "den"} <= set(content):
        raise InputError(
            f"{where} has the keys {sorted(content)}; a plant needs num and den, or A, B, C and D."
        )
    return Plant(content["num"], content["den"], dt=dt, **attributes)


def plant_to_json(plant: Plant) -> dict[str, Any]:
    """Describe a plant as a mapping that `plant_from_json` reads back bit for bit.

    Parameters
    ----------
    plant : Plant
        The plant.

    Returns
    -------
    dict
        With plain lists and numbers, ready for `json.dumps`.
    """
    listed = lambda rows: [[list(map(float, entry)) for entry in row] for row in rows]
    description: dict[str, Any] = {
        "name": plant.name,
        "num": listed(plant.num),
        "den": listed(plant.den),
        "dt": plant.dt,
        "noise": {"covariance": plant.noise_covariance.tolist()},
        "free": list(plant.free),
    }
    if not plant.white_noise:
        description["noise"]["filter"] = {"num": plant.noise_num.tolist(), "den": plant.noise_den.tolist()}
    return description
