"""Methods and estimators of the user's own, by function or as `FILE.py:FUNCTION`."""

import inspect
from collections.abc import Callable, Iterable
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

from benchmarks.campaign.registry import run_rule
from estimators.rules.trace import Trace
from oed.errors import InputError
from oed.files.limits import file_content


class Own:
    """What the user brought, with a name for each."""

    def __init__(self, methods: Iterable[Any], estimators: Iterable[Any]) -> None:
        self.functions: dict[str, Callable[..., Any]] = {}
        self.sources: list[tuple[str, str]] = []
        self.methods = tuple(self._name(m, _as_method) for m in methods)
        self.estimators = tuple(self._name(e, lambda function: function) for e in estimators)

    def _name(self, given: Any, wrap: Callable[[Any], Any]) -> str:
        if isinstance(given, str) and ".py:" not in given:
            return given
        if isinstance(given, str):
            function, name = _load(given), given
        elif callable(given):
            function, name = given, getattr(given, "__name__", type(given).__name__)
        else:
            raise InputError(f"{given!r} is no method; give a name, a function or FILE.py:FUNCTION as text.")
        self.functions[name] = wrap(function)
        self.sources.append((name, _digest(function)))
        return name


def _as_method(function: Callable[..., Any]) -> Callable[[Any], Any]:
    inner = function.func if isinstance(function, partial) else function
    method = partial(run_rule, function) if inspect.isgeneratorfunction(inner) else function
    return partial(_for_any_plant, method)


def _for_any_plant(method: Callable[..., Any], plant: Any) -> Callable[..., Any]:
    return partial(_traced, method)


def _traced(method: Callable[..., Any], *given: Any, **options: Any) -> Trace:
    made = method(*given, **options)
    if not isinstance(made, Trace):
        raise TypeError(
            f"the method returned {type(made).__name__}; it must return a Trace, or yield what to apply"
        )
    return made


def _load(spec: str) -> Callable[..., Any]:
    file, _, name = spec.rpartition(":")
    try:
        source = file_content(Path(file)).decode()
    except OSError as error:
        raise InputError(
            f"the file of {spec} cannot be read ({error.strerror}); check the name and the folder."
        ) from None
    # Executed, not imported: pickled by value, the functions reach workers that cannot see the file.
    space: dict[str, Any] = {"__name__": Path(file).stem, "__file__": file}
    try:
        exec(compile(source, file, "exec"), space)  # the user's own file, on the user's own request
    except (Exception, SystemExit) as error:
        raise InputError(f"{file} does not run: {type(error).__name__}: {error}.") from None
    if not callable(space.get(name)):
        raise InputError(f"{file} has no function {name}; give FILE.py:FUNCTION.")
    function = space[name]
    function.oed_source = source
    return function


def _digest(function: Callable[..., Any]) -> str:
    """Digest of the source, so that results of another version of the function are not mixed."""
    text = getattr(function, "oed_source", None)
    if text is None:
        try:
            text = inspect.getsource(function)
        except (OSError, TypeError):
            # typed at a prompt: no file to read, but what it compiles to
            code = getattr(function, "__code__", None)
            text = f"{code.co_code!r} {code.co_names}" if code else repr(type(function))
    return blake2b(text.encode(), digest_size=8).hexdigest()
