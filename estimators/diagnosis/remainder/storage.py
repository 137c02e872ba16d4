"""A remainder as plain numbers and back: JSON, never a pickle."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from estimators.diagnosis.ladder.steps import Gain
from estimators.diagnosis.remainder.members import Networks, Scale
from estimators.diagnosis.remainder.mixture import Remainder
from estimators.diagnosis.remainder.network import Network, Sizes
from estimators.diagnosis.remainder.ridge import Ridge, Set
from estimators.diagnosis.remainder.trees import Trees
from estimators.diagnosis.share.signals import Bank
from oed.errors import InputError

FORM = "remainder 1"
"""Name and version of the form; another one is refused."""


NODES = {"roots": int, "feature": int, "threshold": float, "left": int, "right": int, "value": float}
"""Arrays of the trees, and what their entries are."""


def to_json(rest: Remainder) -> str:
    """The model itself; its predictions of the training records stay behind."""
    head = {
        k: getattr(rest, k) for k in ("output", "fade", "rmse_unused", "admitted", "why", "error", "feedback")
    }
    arrays = {k: getattr(rest, k).tolist() for k in ("weights", "low", "high")}
    members = [_written(m) for m in rest.members]
    return json.dumps({"form": FORM, **head, **arrays, "gain": asdict(rest.gain), "members": members})


def _written(member: Ridge | Networks | Trees) -> dict[str, Any]:
    if isinstance(member, Networks):
        scale = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(member.scale).items()}
        nets = [n.theta.tolist() for n in member.networks]
        sizes = asdict(member.networks[0].sizes)
        return {"networks": nets, "sizes": sizes, "scale": scale, "bounds": member.bounds}
    if isinstance(member, Trees):
        nodes = {k: getattr(member, k).tolist() for k in NODES}
        return {"trees": nodes, "bank": asdict(member.bank), "level": member.level, "bounds": member.bounds}
    arrays = {k: getattr(member, k).tolist() for k in ("low", "high", "centre", "spread", "weights")}
    return {"set": member.which.value, "bank": asdict(member.bank), **arrays, "bounds": member.bounds}


def from_json(text: str) -> Remainder:
    """The model that `to_json` wrote; `unused` is empty."""
    try:
        told = json.loads(text)
        if told["form"] != FORM:
            raise ValueError(f"the form is {told['form']!r}")
        members = tuple(_read(m) for m in told["members"])
        arrays = {k: np.array(told[k], dtype=float) for k in ("weights", "low", "high")}
        begin, end = told["fade"]
        least, most = told["error"]
        return Remainder(
            output=int(told["output"]), members=members, **arrays, fade=(begin, end), unused=(),
            rmse_unused=float(told["rmse_unused"]), gain=Gain(**told["gain"]), admitted=bool(told["admitted"]),
            why=str(told["why"]), error=(least, most),
            feedback=bool(told["feedback"]),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"this is no {FORM!r} ({error}); give what to_json wrote.") from None


def _read(told: Mapping[str, Any]) -> Ridge | Networks | Trees:
    low, high = told["bounds"]
    if "networks" in told:
        own = told["scale"]
        scale = {k: np.array(own[k], dtype=float) for k in ("centre", "spread", "low", "high")}
        sizes = Sizes(**told["sizes"])
        nets = tuple(Network(sizes, np.array(theta, dtype=float)) for theta in told["networks"])
        return Networks(Scale(**scale, level=own["level"], size=own["size"]), nets, (low, high))
    bank = Bank(**{k: _tuples(v) for k, v in told["bank"].items()})
    if "trees" in told:
        nodes = {k: np.array(v, dtype=NODES[k]) for k, v in told["trees"].items()}
        return Trees(bank, **nodes, level=float(told["level"]), bounds=(low, high))
    arrays = {k: np.array(told[k], dtype=float) for k in ("low", "high", "centre", "spread", "weights")}
    return Ridge(which=Set(told["set"]), bank=bank, **arrays, bounds=(low, high))


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value
