"""Names that a package exports, imported when they are first used: `import oed` stays quick."""

import ast
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pkgutil import get_data
from typing import Any

EXTRAS = {
    "pandas": "files", "pyarrow": "files", "h5py": "files", "xarray": "files", "control": "control", "cvxpy": "convex", "casadi": "casadi",
    "matplotlib": "report", "altair": "report", "vl_convert": "report", "joblib": "compare", "tqdm": "compare", "distributed": "dask",
}  # fmt: skip
"""What a light install does not have, and the extra that brings it."""


class MissingExtra(ModuleNotFoundError):
    """An import of ours of what is not installed; the message names the extra that brings it."""

    def __init__(self, package: str) -> None:
        super().__init__(
            f"{package} is not installed; pip install 'oed[{EXTRAS[package]}]' brings it", name=package
        )

    def __reduce__(self) -> tuple[type, tuple[str | None]]:
        return type(self), (self.name,)


class _Extras:
    """The last of Python's finders: what no other found, and one of our own modules imports, is said with its extra. What
    others import, or ask for by `importlib.util.find_spec`, is left to them."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        frame = sys._getframe(1)
        while frame is not None and frame.f_globals.get("__name__") in (
            "importlib._bootstrap",
            "_frozen_importlib",
            "importlib",
        ):
            frame = frame.f_back
        asks = frame.f_globals.get("__name__", "") if frame is not None else ""
        if name in EXTRAS and asks.partition(".")[0] in ("oed", "estimators", "benchmarks"):
            raise MissingExtra(name)


sys.meta_path.append(_Extras)


def exporting(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package that exports what its block `if TYPE_CHECKING:` imports."""
    lines = ast.parse(get_data(package, "__init__.py") or b"").body
    block = next(line for line in lines if isinstance(line, ast.If)).body
    homes = {
        one.name: f"{line.module}" for line in block if isinstance(line, ast.ImportFrom) for one in line.names
    }

    def attribute(name: str) -> Any:
        if name in homes:
            return getattr(import_module(homes[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute, lambda: sorted(homes)


@contextmanager
def where_installed(notes: list[str], what: str) -> Iterator[None]:
    """What is written only where the extra of reports is installed; else a note that names it."""
    try:
        yield
    except MissingExtra as error:
        notes.append(
            f"note: {what} is not written: {error.name} is not installed; pip install 'oed[report]' brings what it needs."
        )
