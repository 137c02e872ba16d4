"""The limits of the house: how many entries a folder has, how long a file is, how many arguments a function takes, that no
module imports itself in a circle, and that ARCHITECTURE.md is the map of what is there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.architecture_map import ROOT, written
from tests.test_architecture import FILES, PACKAGES, dotted, imports

MOST_ENTRIES, MOST_ARGUMENTS = 14, 8

# Kernels are compiled: what travels in one object elsewhere travels as arrays there. The others say why.
WIDE = {
    "estimators/pem/estimation.py identify": "the options are the command's, each with a default; one call is what users expect",
    "benchmarks/comparison.py compare": "the settings of a campaign by name, as in its TOML file",
    "oed/design/solve.py solve_design": "each limit on the input is an argument with a default",
    "estimators/montecarlo/additivity.py additivity_by_monte_carlo": "called from a user's test: each number by its name",
    "estimators/montecarlo/engine.py batches": "hands the compiled loops their arrays",
    "estimators/pem/search/levenberg_marquardt.py minimise": "the search of every engine: functions, start and its limits",
    "oed/design/solvers/condition_number.py _as_design": "gathers the parts of one result",
}
# An effect starts its own fits, and the fits know effects: inside functions only, as `effects/__init__` says.
CYCLES = {
    ("estimators.diagnosis.effects.disturbances.added", "estimators.diagnosis.model.linear"),
}


def entries(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir() if p.name not in ("__pycache__", "__init__.py", "py.typed")]


def test_no_folder_is_too_wide() -> None:
    folders = {path.parent for path in FILES}
    wide = {str(f.relative_to(ROOT)): len(entries(f)) for f in folders if len(entries(f)) > MOST_ENTRIES}
    assert not wide, wide


def wide_functions(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef):
            a = node.args
            names = [
                arg.arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs) if arg.arg not in ("self", "cls")
            ]
            if len(names) > MOST_ARGUMENTS:
                found.append(f"{node.name}")
    return found


def test_no_function_takes_too_many_arguments() -> None:
    found = {
        f"{path.relative_to(ROOT)} {name}"
        for path in FILES
        if not path.stem.endswith("_kernels")
        for name in wide_functions(path)
    }
    assert found <= set(WIDE), sorted(found - set(WIDE))
    assert set(WIDE) <= found, f"no exception is needed for {sorted(set(WIDE) - found)}"


def at_run_time(tree: ast.AST) -> Iterator[ast.AST]:
    """Every node but those under `if TYPE_CHECKING`, which no run imports."""
    yield tree
    for child in ast.iter_child_nodes(tree):
        if not (isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"):
            yield from at_run_time(child)


def graph() -> dict[str, set[str]]:
    modules = {dotted(path) for path in FILES}
    edges: dict[str, set[str]] = {}
    for path in FILES:
        edges[dotted(path)] = set()
        if path.name == "__init__.py":
            continue  # what a package exports, it imports when asked
        for node in at_run_time(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
                named = {f"{node.module}.{alias.name}" for alias in node.names}
                edges[dotted(path)] |= (named | {node.module}) & modules
            elif isinstance(node, ast.Import):
                edges[dotted(path)] |= {alias.name for alias in node.names} & modules
    return edges


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(v: str) -> None:
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in edges.get(v, ()):
            if w not in index:
                visit(w)
                low[v] = min(low[v], low[w])
            elif w in stack:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            component = []
            while True:
                component.append(stack.pop())
                if component[-1] == v:
                    break
            if len(component) > 1:
                found.append(sorted(component))

    for v in edges:
        if v not in index:
            visit(v)
    return found


def test_no_module_imports_itself_in_a_circle() -> None:
    found = [c for c in circles(graph()) if tuple(c) not in CYCLES]
    assert not found, found


def test_a_circle_is_caught() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_the_map_has_whole_sentences() -> None:
    """The first line of a module is its entry in the map: a sentence that goes on in the next line is cut off there."""
    for path in FILES:
        first = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n")[0]
        assert first.endswith((".", ":", "?")), f"{path.relative_to(ROOT)}: {first}"


def test_the_map_is_of_this_tree() -> None:
    assert (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8") == written(), "make map"


def test_imports_are_seen() -> None:
    assert any(name == "oed.errors" for _, name in imports(ROOT / "oed" / "data.py"))


@pytest.mark.parametrize("name", ["ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_paths_named_in_the_guides_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8").split("## The tree")[0]
    paths = re.findall(r"`((?:oed|estimators|benchmarks|tests|docs)/[\w/.*]+)`", text)
    missing = [p for p in paths if not (ROOT / p).exists()]
    assert paths, "the guide names no path"
    assert not missing, missing


def test_functions_named_in_the_guide_exist() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").split("## The tree")[0]
    named = [
        (path, name)
        for path, words in re.findall(r"`([\w/]+\.py)`\s\(([^)]*)\)", text)
        for name in re.findall(r"`(\w+)`", words)
    ]
    missing = [(p, n) for p, n in named if f"def {n}(" not in (ROOT / p).read_text(encoding="utf-8")]
    assert named, "the guide names no function"
    assert not missing, missing
