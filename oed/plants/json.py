"""Plants from and to JSON: the files that `oed --plant FILE.json` reads."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from oed.errors import InputError
from oed.files.documents import NUMBER, WHOLE, checked, keyed, listed, read_document
from oed.files.writing import in_text
from oed.models.model import saved_model
from oed.plants.plant import Plant

LONGEST_NUM, LONGEST_DEN = 20_000, 2_000
"""Coefficients: poles are eigenvalues of a matrix of that size, zeros are not computed."""


def _polynomials(longest: int) -> dict[str, Any]:
    flat = {"type": "array", "items": NUMBER, "minItems": 1, "maxItems": longest}
    row = {"type": "array", "items": flat, "minItems": 1}
    return {
        "anyOf": [flat, {"type": "array", "items": row, "minItems": 1}],
        "description": f"a list of at most {longest} coefficients of powers of z^-1, or a row per output with such a list "
        "per input",
    }


def _matrix(rule: str) -> dict[str, Any]:
    row = {"type": "array", "items": NUMBER, "minItems": 1, "maxItems": LONGEST_DEN}
    return {"anyOf": [NUMBER, row, {"type": "array", "items": row, "minItems": 1}], "description": rule}


PLANT = keyed(
    {
        "num": _polynomials(LONGEST_NUM),
        "den": _polynomials(LONGEST_DEN),
        **{name: _matrix("a matrix of numbers, row by row") for name in "ABCD"},
        "dt": {"type": "number", "description": "the sampling time in seconds"},
        "noise": keyed(
            {
                "variance": {"type": "number", "minimum": 0, "description": "a number of at least 0"},
                "covariance": _matrix("a number, or a matrix with a row per output"),
                "filter": keyed({name: _polynomials(LONGEST_DEN) for name in ("num", "den")}, ("num", "den")),
            }
        ),
        "free": listed({"type": "string", "description": "the name of a parameter"}, "parameters' names"),
        "name": {"type": "string", "minLength": 1, "description": "a text"},
        "schema_version": WHOLE,
    }
)
"""What a plant file may hold."""


def plant_from_json(source: str | Path | Mapping[str, Any], *, noise_variance: float | None = None) -> Plant:
    """Read a plant from a JSON file or an already parsed mapping.

    Parameters
    ----------
    source : str, Path or mapping
        A file with `num`, `den`, `dt` (or `A`, `B`, `C`, `D`, `dt`), optionally `noise` and `free`; or a model that
        `oed identify --out` wrote.
    noise_variance : float, optional
        Overrides the variance in the file.

    Returns
    -------
    Plant
        The plant; InputError if the file is not such a description.
    """
    if not isinstance(source, str | Path | Mapping):
        raise InputError(
            f"a plant is given as {type(source).__name__}; give the name of a JSON file, or a mapping like its content."
        )
    model = saved_model(source)
    if model is not None:
        plant = model.to_plant(
            name="identified" if isinstance(source, Mapping) else in_text(Path(source).parent.name)
        )
        return plant if noise_variance is None else plant.replace(noise_variance=noise_variance)
    if isinstance(source, Mapping):
        content, name = checked(_plain(source), PLANT, "the plant"), "plant"
        where = "the plant"
    else:
        content, name = read_document(source, PLANT, "the plant file"), in_text(Path(source).stem)
        where = str(source)
    try:
        return _plant_of(content, name, where, noise_variance)
    except InputError as error:
        said = str(error)
        raise InputError(said if where in said else f"{where}: {said}") from None


def _plant_of(content: Mapping[str, Any], name: str, where: str, noise_variance: float | None) -> Plant:
    """The plant of a description whose keys and types are as they should be."""
    noise = content.get("noise", {})
    attributes: dict[str, Any] = {"name": content.get("name", name), "free": tuple(content.get("free", ()))}
    if "covariance" in noise or "variance" in noise:
        attributes["noise_covariance"] = noise.get("covariance", noise.get("variance"))
    if "filter" in noise:
        attributes["noise_num"], attributes["noise_den"] = noise["filter"]["num"], noise["filter"]["den"]
    if noise_variance is not None:
        attributes["noise_covariance"] = noise_variance
    if {"covariance", "variance"} <= set(noise):
        raise InputError(f"{where} gives a variance and a covariance of the noise; give one of them.")
    if {"num", "den"} & set(content) and set("ABCD") & set(content):
        raise InputError(f"{where} has num or den and A, B, C or D; a plant is given in one of the two ways.")
    dt = content.get("dt", 1.0)
    if dt in (0, 0.0):
        raise InputError(
            f"{where} has dt = 0, a continuous-time plant; sample it first with a sampling time and a hold, "
            'for example Plant.from_control(system, dt=0.01, hold="zoh").'
        )
    if {"A", "B", "C"} <= set(content):
        return Plant.from_state_space(
            content["A"], content["B"], content["C"], content.get("D"), dt=dt, **attributes
        )
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
        "name": plant.name, "num": listed(plant.num), "den": listed(plant.den), "dt": plant.dt,
        "noise": {"covariance": plant.noise_covariance.tolist()}, "free": list(plant.free),
    }  # fmt: skip
    if not plant.white_noise:
        description["noise"]["filter"] = {"num": plant.noise_num.tolist(), "den": plant.noise_den.tolist()}
    return description


def _plain(value: Any) -> Any:
    """Arrays and tuples as lists, so that a mapping made in Python is checked like a file."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
