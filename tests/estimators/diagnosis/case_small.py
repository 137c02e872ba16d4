"""What makes a diagnosis cheap where a test is about one part of it: few effects, few orders, a linear model of two poles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from estimators.diagnosis.baseline import best, search
from estimators.diagnosis.discovery import BUDGETS, Budget
from estimators.diagnosis.effects import named
from estimators.diagnosis.policy import Effort, Setting

__all__ = ["looking_for", "of_orders", "two_poles"]


def looking_for(*keys: str, **known: Any) -> Setting:
    """A quick search for effects of the catalogue, those that a test is about and what they are taken for, and nothing else."""
    return Setting(effects=tuple(map(named, keys)), effort=Effort.QUICK, **known)


def of_orders(*orders: int) -> Budget:
    """A quick search for terms beside chains of these orders, which are the plant's."""
    return replace(BUDGETS["quick"], orders=orders)


def two_poles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The linear model is one of two poles and a sample of delay: no other is tried, and a record takes half a second."""
    for name, value in (("ORDERS", (2,)), ("REFINED", (2,))):
        monkeypatch.setattr(search, name, value)
        monkeypatch.setattr(best, name, value)
    monkeypatch.setattr(search, "DELAYS", (1,))
    monkeypatch.setattr(best, "_screened", lambda s: (s, s.arx(few=True), []))
