"""The map of the repository, from the first line of every module: `python -m tests.architecture_map` writes ARCHITECTURE.md's tree."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MARK = "Made by `make map` from the first line of every module; a test holds it.\n"


def tree() -> str:
    """One line per package and module, indented by depth."""
    lines = ["```text"]
    for package in ("oed", "estimators", "benchmarks"):
        for path in sorted((ROOT / package).rglob("*.py"), key=_order):
            said = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n")[0]
            parts = path.relative_to(ROOT).parts
            home = path.name == "__init__.py"
            depth, name = (len(parts) - 2, parts[-2] + "/") if home else (len(parts) - 1, path.stem)
            lines.append(f"{'  ' * depth}{name:<{max(1, 30 - 2 * depth)}} {said}")
    return "\n".join([*lines, "```", ""])


def _order(path: Path) -> tuple:
    """A package before its modules, modules before subpackages."""
    parts = path.relative_to(ROOT).parts
    return tuple((1, part) for part in parts[:-1]) + ((0, "" if parts[-1] == "__init__.py" else parts[-1]),)


def written() -> str:
    """ARCHITECTURE.md as it should be."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    return text[: text.index(MARK) + len(MARK)] + "\n" + tree()


if __name__ == "__main__":
    (ROOT / "ARCHITECTURE.md").write_text(written(), encoding="utf-8")
