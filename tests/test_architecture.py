"""The rules of the house, read off the source: who may import what, and what no file may hold.

import-linter (`make lint`) holds the layers over the whole import graph. These tests read every file's syntax tree
and add the rules that go by a file's name.
"""

from __future__ import annotations

import abc
import ast
import importlib
import inspect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("oed", "estimators", "benchmarks")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
MOST_LINES = 400

# What a package may import of the project: one way, oed <- estimators <- benchmarks.
LAYERS = {
    "oed": {"oed"},
    "estimators": {"oed", "estimators"},
    "benchmarks": {"oed", "estimators", "benchmarks"},
}


def dotted(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def within(module: str, *homes: str) -> bool:
    return any(module == home or module.startswith(home + ".") for home in homes)


def last(module: str) -> str:
    return module.rpartition(".")[2]


def in_plots(module: str) -> bool:
    return any(part in ("plots", "report") or part.startswith("figures") for part in module.split(".")[1:])


# Third-party package: (where it may be imported, in words, and as a rule on the module's dotted name).
HOMES = {
    "cvxpy": ("oed.design", lambda module: within(module, "oed.design")),
    "clarabel": ("oed.design", lambda module: within(module, "oed.design")),
    "casadi": (
        "estimators.pem and estimators.diagnosis.effects",
        lambda module: within(module, "estimators.pem", "estimators.diagnosis.effects"),
    ),
    "matplotlib": ("modules named plots, figures* or report", in_plots),
    "numba": ("modules named *_kernels", lambda module: last(module).endswith("_kernels")),
    "joblib": ("benchmarks", lambda module: within(module, "benchmarks")),
    "dask": ("benchmarks", lambda module: within(module, "benchmarks")),
    "distributed": ("benchmarks", lambda module: within(module, "benchmarks")),
    "jsonschema": ("oed.files", lambda module: within(module, "oed.files")),
    "slycot": ("the tests", lambda module: False),
    "pickle": ("no module", lambda module: False),
} | {
    name: ("oed.files and benchmarks", lambda module: within(module, "oed.files", "benchmarks"))
    for name in ("pandas", "pyarrow", "h5py", "xarray")
}


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imports(path: Path) -> list[tuple[int, str]]:
    """Every module that the file imports, at the top or inside a function, with its line."""
    module = dotted(path)
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    found = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            found.append((node.lineno, ".".join([*base, *([node.module] if node.module else [])])))
        elif isinstance(node, ast.Call) and last(called(node)) in ("import_module", "__import__"):
            found += [(node.lineno, name) for name in map(literal, node.args[:1]) if name]
    return found


def literal(node: ast.expr) -> str:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def called(node: ast.Call) -> str:
    """The dotted name that a call calls, `` where it is not a plain name."""
    parts, target = [], node.func
    while isinstance(target, ast.Attribute):
        parts.append(target.attr)
        target = target.value
    return (
        ".".join([target.id, *reversed(parts)]) if isinstance(target, ast.Name) else ".".join(reversed(parts))
    )


def public_functions(path: Path) -> list[str]:
    return [
        node.name
        for node in tree(path).body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_")
    ]


def each(paths: list[Path]):
    return pytest.mark.parametrize(
        "path", [pytest.param(path, id=str(path.relative_to(ROOT))) for path in paths]
    )


@each(FILES)
def test_layers(path: Path) -> None:
    own = dotted(path).split(".")[0]
    wrong = [
        f"line {line}: {name}"
        for line, name in imports(path)
        if name.split(".")[0] in {*PACKAGES, "tests"} - LAYERS[own]
    ]
    assert not wrong, f"{own} may import only {sorted(LAYERS[own])} of the project: {wrong}"


@each(FILES)
def test_third_party_imports_stay_at_home(path: Path) -> None:
    module = dotted(path)
    wrong = []
    for line, name in imports(path):
        where, allowed = HOMES.get(name.split(".")[0], ("", None))
        if allowed is not None and not allowed(module):
            wrong.append(f"line {line}: {name} (only in {where})")
    assert not wrong, wrong


@each(FILES)
def test_length(path: Path) -> None:
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines <= MOST_LINES, f"{lines} lines: one noun per file, at most {MOST_LINES}"


@each([*FILES, *TESTS])
def test_nothing_is_left_to_do(path: Path) -> None:
    words = "|".join(("TO" + "DO", "FIX" + "ME", "XX" + "X", "NotImplemented" + "Error"))
    text = path.read_text(encoding="utf-8")
    found = [
        f"line {text[: hit.start()].count(chr(10)) + 1}: {hit[0]}"
        for hit in re.finditer(rf"\b({words})\b", text)
    ]
    assert not found, found


@each(FILES)
def test_module_says_what_it_is(path: Path) -> None:
    assert ast.get_docstring(tree(path)), "the module has no docstring"


@each(
    [path for path in FILES if path.is_relative_to(ROOT / "oed") or path.is_relative_to(ROOT / "estimators")]
)
def test_mathematics_neither_prints_nor_exits_nor_asserts(path: Path) -> None:
    wrong = []
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Assert):
            wrong.append(f"line {node.lineno}: assert")
        elif isinstance(node, ast.Call) and called(node) in (
            "print",
            "input",
            "exit",
            "quit",
            "sys.exit",
            "os._exit",
        ):
            wrong.append(f"line {node.lineno}: {called(node)}()")
        elif isinstance(node, ast.Raise) and node.exc is not None and "SystemExit" in ast.unparse(node.exc):
            wrong.append(f"line {node.lineno}: SystemExit")
    assert not wrong, f"bad input is an exception of oed.errors: {wrong}"


@each(FILES)
def test_no_hasattr_and_no_pickle(path: Path) -> None:
    wrong = []
    for node in ast.walk(tree(path)):
        if not isinstance(node, ast.Call):
            continue
        if called(node) == "hasattr":
            wrong.append(f"line {node.lineno}: hasattr()")
        wrong += [
            f"line {node.lineno}: allow_pickle"
            for keyword in node.keywords
            if keyword.arg == "allow_pickle"
            and not (isinstance(keyword.value, ast.Constant) and keyword.value.value is False)
        ]
    assert not wrong, wrong


# Who writes files: one writer and the lock.
WRITERS = ("oed/files/writing.py", "oed/files/lock.py")


@each([path for path in FILES if path.relative_to(ROOT).as_posix() not in WRITERS])
def test_files_are_written_by_the_one_writer(path: Path) -> None:
    wrong = []
    for node in ast.walk(tree(path)):
        if not isinstance(node, ast.Call):
            continue
        name = called(node)
        mode = [*node.args[:2], *(k.value for k in node.keywords if k.arg == "mode")]
        opens = last(name) == "open" and any(
            set(literal(m)) & set("wax+") and len(literal(m)) < 5 for m in mode
        )
        if opens or last(name) in ("write_text", "savetxt", "savefig") or name in ("os.replace", "os.rename"):
            wrong.append(f"line {node.lineno}: {name}()")
    allowed = ("np.savetxt",)  # into memory, in traces
    wrong = [entry for entry in wrong if not any(name in entry for name in allowed)]
    assert not wrong, f"whole or not at all, also after a power cut: use oed.files.writing: {wrong}"


@each([path for path in FILES if not path.is_relative_to(ROOT / "benchmarks")])
def test_dataclasses_are_frozen(path: Path) -> None:
    wrong = []
    for node in ast.walk(tree(path)):
        if not isinstance(node, ast.ClassDef):
            continue
        for decorator in node.decorator_list:
            call = decorator if isinstance(decorator, ast.Call) else None
            name = called(call) if call else ast.unparse(decorator)
            if last(name) != "dataclass":
                continue
            given = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords} if call else {}
            fields = [ast.unparse(item.annotation) for item in node.body if isinstance(item, ast.AnnAssign)]
            if given.get("frozen") != "True":
                wrong.append(f"line {node.lineno}: {node.name} is not frozen")
            if given.get("eq") != "False" and any(re.search(r"[Aa]rray", field) for field in fields):
                wrong.append(
                    f"line {node.lineno}: {node.name} holds arrays and lacks eq=False (its == would raise)"
                )
    assert not wrong, wrong


@each(FILES)
def test_only_packages_say_what_is_public(path: Path) -> None:
    # Public is what a package's `__init__` exports; within a package an underscore says that a name stays in its file.
    names = [ast.unparse(node.targets[0]) for node in tree(path).body if isinstance(node, ast.Assign)]
    imports = [node for node in tree(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
    gathers = path.name == "__init__.py" and any(
        ast.unparse(node) != "from __future__ import annotations" for node in imports
    )
    assert ("__all__" in names) == gathers, (
        "an `__init__` that gathers names has `__all__`, and no other file"
    )


def test_no_name_is_both_a_module_and_a_function() -> None:
    # `from package import name` must have one meaning: a function may not be named like its own or a sibling
    # module. benchmarks/commands holds one file per word of the command line, reached by that word alone.
    both = []
    for path in FILES:
        if path.is_relative_to(ROOT / "benchmarks" / "commands"):
            continue
        siblings = {file.stem for file in path.parent.glob("*.py")} | {
            d.name for d in path.parent.iterdir() if d.is_dir()
        }
        both += [f"{name} in {path.relative_to(ROOT)}" for name in public_functions(path) if name in siblings]
    assert not both, both


@each([path for path in FILES if path.stem.endswith("_kernels")])
def test_kernel_has_a_twin_in_the_tests(path: Path) -> None:
    others = [test.read_text(encoding="utf-8") for test in TESTS if test.name != Path(__file__).name]
    assert any(re.search(rf"\b{path.stem}\b", text) for text in others), (
        f"no test names {path.stem}: a compiled kernel needs its plain twin in the tests"
    )


@each([path for path in FILES if not path.stem.startswith("__main__")])
def test_no_concrete_method_is_overridden(path: Path) -> None:
    module = importlib.import_module(dotted(path))
    wrong = []
    for name, cls in inspect.getmembers(module, inspect.isclass):
        if cls.__module__ != module.__name__:
            continue
        for method, member in vars(cls).items():
            if method.startswith("__") or not inspect.isroutine(member):
                continue
            for base in cls.__mro__[1:]:
                ours = base.__module__.split(".")[0] in PACKAGES and base is not abc.ABC
                theirs = vars(base).get(method)
                if ours and theirs is not None and not getattr(theirs, "__isabstractmethod__", False):
                    wrong.append(f"{name}.{method} overrides {base.__name__}.{method}")
    assert not wrong, wrong


def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> Path:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("name", "text", "rule"),
    [
        ("oed/data.py", "from estimators import trace\n", test_layers),
        ("estimators/power.py", "def f():\n    import benchmarks.cli\n", test_layers),
        ("oed/criteria/trace.py", "import cvxpy as cp\n", test_third_party_imports_stay_at_home),
        ("oed/design/lmi.py", "import casadi\n", test_third_party_imports_stay_at_home),
        ("estimators/fast.py", "from numba import njit\n", test_third_party_imports_stay_at_home),
        (
            "benchmarks/tables.py",
            "def f():\n    import matplotlib.pyplot\n",
            test_third_party_imports_stay_at_home,
        ),
        (
            "oed/data.py",
            "import importlib\nimportlib.import_module('pandas')\n",
            test_third_party_imports_stay_at_home,
        ),
        ("oed/data.py", "# one more line\n" * (MOST_LINES + 1), test_length),
        ("oed/data.py", "# TO" + "DO\n", test_nothing_is_left_to_do),
        ("oed/data.py", "x = 1\n", test_module_says_what_it_is),
        ("oed/data.py", "__all__ = []\n", test_only_packages_say_what_is_public),
        ("oed/data.py", "assert 1 > 0\n", test_mathematics_neither_prints_nor_exits_nor_asserts),
        ("oed/data.py", "import sys\nsys.exit(2)\n", test_mathematics_neither_prints_nor_exits_nor_asserts),
        ("oed/data.py", "print(1)\n", test_mathematics_neither_prints_nor_exits_nor_asserts),
        ("oed/data.py", "hasattr(1, 'real')\n", test_no_hasattr_and_no_pickle),
        ("oed/data.py", "np.load(f, allow_pickle=True)\n", test_no_hasattr_and_no_pickle),
        ("oed/data.py", "@dataclass\nclass A:\n    x: int\n", test_dataclasses_are_frozen),
        ("oed/data.py", "@dataclass(frozen=True)\nclass A:\n    x: NDArray\n", test_dataclasses_are_frozen),
        ("oed/lonely_kernels.py", "import numba\n", test_kernel_has_a_twin_in_the_tests),
    ],
)
def test_a_broken_rule_is_caught(tmp_path, monkeypatch, name, text, rule) -> None:
    """The negative control: a file that breaks a rule fails that rule's test."""
    path = planted(tmp_path, monkeypatch, name, text)
    with pytest.raises(AssertionError):
        rule(path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("oed/design/grid.py", "import cvxpy as cp\nfrom oed.data import Spectrum\n"),
        ("estimators/pem/predictor.py", "import casadi\nfrom ..trace import Trace\n"),
        ("estimators/power_kernels.py", "from numba import njit\n"),
        ("benchmarks/figures_spectra.py", "import matplotlib.pyplot as plt\nimport pandas\n"),
        ("oed/files/table.py", "def f():\n    import pandas\n"),
    ],
)
def test_a_kept_rule_passes(tmp_path, monkeypatch, name, text) -> None:
    path = planted(tmp_path, monkeypatch, name, text)
    test_layers(path)
    test_third_party_imports_stay_at_home(path)


def test_lock_names_no_index_and_hashes_everything() -> None:
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert not re.search(
        r"https?://|^\s*-|--(extra-)?index-url|--find-links", lock.replace("    --hash", ""), re.MULTILINE
    )
    pinned = re.split(r"\n(?=\S)", lock.strip())
    bare = [entry.split("==")[0] for entry in pinned if "==" not in entry or "--hash=sha256:" not in entry]
    assert not bare, bare
    assert {entry.split("==")[0] for entry in pinned} >= {"hatchling", "editables", "numpy"}
