"""What a package's `__init__` exports is documented in numpydoc style; every other name without an underscore has
a sentence; every example in a docstring runs."""

from __future__ import annotations

import ast
import dataclasses
import doctest
import enum
import importlib
import inspect
import os
import re
import sys
import types
from pathlib import Path

import pytest
from numpydoc.docscrape import NumpyDocString
from numpydoc.validate import validate

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("oed", "estimators", "benchmarks")

# The packages whose exports are public. The `__init__` of a room inside them only gathers names for its neighbours.
PUBLIC = (
    "oed", "oed.design", "oed.theory", "oed.signals", "oed.files", "estimators", "estimators.pem", "estimators.residual",
    "estimators.diagnosis", "estimators.diagnosis.effects", "estimators.sessions",
)  # fmt: skip

# What is demanded, of numpydoc's checks. Left out are those of taste: where the text begins, capitals and full stops,
# "See Also", "Notes" and "Examples" for everything.
DEMANDED = {
    "GL05": "tabs",
    "GL06": "unknown section",
    "GL07": "sections out of order",
    "GL08": "no docstring",
    "SS01": "no summary",
    "PR01": "parameters not documented",
    "PR02": "unknown parameters documented",
    "PR03": "parameters out of order",
    "PR04": "parameter without type or shape",
    "PR07": "parameter without description",
    "PR10": "no space before the colon between a parameter and its type",
    "RT01": "no Returns section",
    "RT03": "return value without description",
    "YD01": "no Yields section",
}


def module_names() -> list[str]:
    """Every public module in the three packages: no part of its name begins with an underscore."""
    names = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            if not any(part.startswith("_") for part in parts):
                names.append(".".join(parts))
    return names


def documented_objects(exported: bool) -> dict[str, object]:
    """Functions and classes by the name of their home, with the classes' own public methods: those that a package's
    `__init__` exports, or all that a module defines without an underscore."""
    found: dict[str, object] = {}
    for name in module_names():
        if exported and name not in PUBLIC:
            continue
        try:
            module = importlib.import_module(name)
        except Exception as error:
            found[name] = error
            continue
        own = [
            key
            for key, member in vars(module).items()
            if getattr(member, "__module__", "") == name and key[0] != "_"
        ]
        for public in getattr(module, "__all__", ()) if exported else own:
            try:
                member = getattr(module, public)
            except Exception as error:
                found[f"{name}.{public}"] = error
                continue
            if not (inspect.isclass(member) or inspect.isroutine(member)):
                continue
            if str(getattr(member, "__module__", "")).split(".")[0] not in PACKAGES:
                continue
            home = f"{member.__module__}.{member.__qualname__}"
            found[home] = member
            if inspect.isclass(member):
                found |= {f"{home}.{method}": vars(member)[method] for method in _methods(member)}
    return dict(sorted(found.items()))


def _methods(cls: type) -> list[str]:
    kinds = (types.FunctionType, classmethod, staticmethod, property)
    return [
        name for name, member in vars(cls).items() if not name.startswith("_") and isinstance(member, kinds)
    ]


def fields_wrong(cls: type) -> list[str]:
    """What is wrong with how a dataclass documents its fields, in Parameters or in Attributes."""
    document = NumpyDocString(inspect.getdoc(cls) or "")
    entries = [*document["Parameters"], *document["Attributes"]]
    documented = [name.strip() for entry in entries for name in entry.name.split(",")]
    fields = [
        field.name for field in dataclasses.fields(cls) if field.init and not field.name.startswith("_")
    ]
    wrong = [f"PR01: field {name} is not documented" for name in fields if name not in documented]
    wrong += [
        f"PR02: there is no {name}" for name in documented if name not in fields and not _holds(cls, name)
    ]
    if [name for name in documented if name in fields] != [name for name in fields if name in documented]:
        wrong.append(f"PR03: the fields' order is {fields}")
    wrong += [f"PR04: {entry.name} has no type" for entry in entries if not entry.type]
    wrong += [
        f"PR07: {entry.name} has no description" for entry in entries if not "".join(entry.desc).strip()
    ]
    return wrong


def _holds(cls: type, name: str) -> bool:
    return any(name in vars(base) or name in vars(base).get("__annotations__", {}) for base in cls.__mro__)


OBJECTS = documented_objects(exported=True)


@pytest.mark.parametrize("name", OBJECTS)
def test_docstring(name: str) -> None:
    member = OBJECTS[name]
    if isinstance(member, Exception):
        pytest.fail(f"{name}: {type(member).__name__}: {member}", pytrace=False)
    demanded, wrong = set(DEMANDED), []
    if inspect.isclass(member) and (
        issubclass(member, enum.Enum | Exception) or getattr(member, "_is_protocol", False)
    ):
        demanded -= {
            "PR01",
            "PR02",
            "PR03",
        }  # an enumeration's, exception's or protocol's signature is not its own
    elif inspect.isclass(member) and dataclasses.is_dataclass(member):
        demanded -= {
            "PR01",
            "PR02",
            "PR03",
        }  # a field is a parameter and an attribute: either section will do
        wrong += fields_wrong(member)
    wrong += [f"{code}: {words}" for code, words in validate(name)["errors"] if code in demanded]
    if wrong:
        where = inspect.unwrap(getattr(member, "fget", None) or getattr(member, "__func__", member))
        source = Path(inspect.getsourcefile(where) or "").name
        pytest.fail("\n".join([f"{name} ({source})", *wrong]), pytrace=False)


def test_every_other_name_has_a_sentence() -> None:
    silent = [
        name
        for name, member in documented_objects(exported=False).items()
        if isinstance(member, Exception) or not inspect.getdoc(getattr(member, "__func__", member))
    ]
    assert not silent, silent


@pytest.mark.parametrize("name", module_names())
def test_examples(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module(name)
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    said: list[str] = []
    for test in doctest.DocTestFinder().find(module, name):
        runner.run(test, out=said.append)
    if runner.failures:
        pytest.fail("".join(said), pytrace=False)
    assert os.getcwd() == str(tmp_path), "an example changed the working directory"


def test_bad_docstrings_are_caught() -> None:
    """The negative control: an object without a docstring and one with a wrong one are both caught."""
    codes = {code for code, _ in validate("tests_of_docstrings_undocumented.bare")["errors"]}
    assert codes >= {"GL08"}
    codes = {code for code, _ in validate("tests_of_docstrings_undocumented.wrong")["errors"]}
    assert codes >= {"PR01", "PR02", "RT01"}
    assert [sentence[:4] for sentence in fields_wrong(_Wrong)] == ["PR01", "PR02", "PR07"]


@pytest.fixture(autouse=True)
def _undocumented(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.node.name != "test_bad_docstrings_are_caught":
        return
    module = types.ModuleType("tests_of_docstrings_undocumented")
    module.bare, module.wrong = _bare, _wrong  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)


def _bare(x):
    return x


def _wrong(x):
    """Say something.

    Parameters
    ----------
    y : float
        Not the parameter.
    """
    return x


@dataclasses.dataclass(frozen=True)
class _Wrong:
    """Hold something.

    Attributes
    ----------
    y : float
    """

    x: float


def _written_signatures() -> list[tuple[str, str, str, str]]:
    """(package, verb, parameter, default) of every `verb(..., parameter=default, ...) -> X` in a package's docstring."""
    found = []
    for package in (
        name for name in module_names() if (ROOT / name.replace(".", "/") / "__init__.py").exists()
    ):
        module = importlib.import_module(package)
        for verb, arguments in re.findall(
            r"(\w+)\(([^()]*(?:\([^()]*\)[^()]*)*)\) -> ", module.__doc__ or ""
        ):
            found += [(package, verb, *pair) for pair in re.findall(r"(\w+)=(\([^)]*\)|[^,\s]+)", arguments)]
    return found


def test_defaults_in_package_docstrings_are_the_defaults() -> None:
    """solve_design's tolerance was written as 1e-9 and is 1e-7; a verb that is not there fails too."""
    written = _written_signatures()
    assert {verb for _, verb, _, _ in written} >= {"solve_design", "identify"}
    for package, verb, parameter, default in written:
        known = inspect.signature(getattr(importlib.import_module(package), verb)).parameters
        assert known[parameter].default == ast.literal_eval(default), (package, verb, parameter)


def test_sizes_in_identify_docstring_are_those_of_the_search() -> None:
    from estimators.pem import identify
    from estimators.pem.search.global_search import FEW, MANY, SOME

    text = " ".join(str(identify.__doc__).split())
    assert (
        f"on up to {FEW} samples always) and up to {int(1.5 * MANY)} samples, and on up to {SOME} samples"
        in text
    )
