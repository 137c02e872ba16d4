"""Names that a package exports, imported when they are first used: `import oed` stays quick."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

EXTRAS = {
    "pandas": "files", "pyarrow": "files", "h5py": "files", "xarray": "files", "control": "control", "cvxpy": "convex", "casadi": "casadi",
    "matplotlib": "report", "altair": "report", "vl_convert": "report", "joblib": "compare", "tqdm": "compare", "distributed": "dask",
}  # fmt: skip
"""What a light install does not have, and the extra that brings it."""


def extra_named(error: ModuleNotFoundError) -> str:
    """What to install where an import failed; empty where it is no extra of ours."""
    package = (error.name or "").partition(".")[0]
    remedy = f"{package} is not installed; pip install 'oed[{EXTRAS.get(package)}]' brings it"
    return remedy if package in EXTRAS else ""


def exporting(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that exports names, given by their home modules: "Record Spectrum"."""
    homes = {name: home for home, those in names.items() for name in those.split()}

    def attribute(name: str) -> Any:
        if name in homes:
            return getattr(import_module(homes[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute, lambda: sorted(homes)


@contextmanager
def where_installed(notes: list[str], what: str) -> Iterator[None]:
    """What is written only where its extra is installed; else a note that names the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        if not extra_named(error):
            raise
        notes.append(f"note: {what} is not written: {extra_named(error)}.")
