"""Names of parameters that come several times over."""

from __future__ import annotations

from collections.abc import Mapping


def numbered(names: Mapping[str, str], count: int) -> list[tuple[str, str]]:
    """Names and units of parameters that come several times over."""
    return [(f"{name}{i + 1}", unit) for i in range(count) for name, unit in names.items()]
