"""The command `oed`: one subcommand per file of the folders of `benchmarks.commands`.

Exit status: 0 when the command did its job, 2 for bad input (one clear line), 130, 143 and 129 when Ctrl-C, SIGTERM
or SIGHUP ended it (what is kept is said), 1 for anything else. A reader of the output that goes away, such as `head`, changes
neither what is written to files nor the exit status. With `--json` standard output carries one JSON object and nothing
else, whatever a solver prints below Python."""

import argparse
import contextlib
import io
import json
import math
import os
import pkgutil
import re
import signal
import sys
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from typing import Any, NoReturn

import benchmarks.commands
import oed
from benchmarks.commands import natural
from benchmarks.commands.endings import ended_by_signals, how, leave_in_peace
from oed.errors import (
    CampaignError,
    InfeasibleDesign,
    InputError,
    NotIdentifiable,
    OedError,
    check_names,
    interruption,
    near,
)
from oed.lazily import MissingExtra

SCHEMA_VERSION = 1
BAD_INPUT = (InputError, NotIdentifiable, InfeasibleDesign, CampaignError)

NUMBERS = {
    "int": "a whole number",
    "natural": "a whole number of at least 0",
    "float": "a number",
    "order": "a whole number or auto, several written apart (2 2)",
}
"""What the message of a wrong argument calls its type."""


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one line."""

    given: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse; what was given is kept for its complaints."""
        self.given = tuple(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        rule = lambda found: f"it is {found[2]}; it must be {NUMBERS.get(found[1], 'another value')}"
        message = re.sub(r"invalid (\w+) value: (.*)", rule, message)
        message += _as_file(self.given, self.options())
        self.exit(2, _one_line(f"{self.prog}: {message}; see {self.prog} --help.") + "\n")

    def options(self) -> list[str]:
        """What may stand behind the command, to guess what was meant."""
        return [word for action in self._actions for word in action.option_strings]


def _as_file(words: Sequence[str], options: Sequence[str] = ()) -> str:
    """How to write the name of a file that reads as an option, if one of the words is such."""
    file = next((w for w in words if w.startswith("-") and w not in options and os.path.isfile(w)), "")
    return f" ({file} is a file here: write ./{file})" if file else ""


TYPESET = "\u201c\u201d\u201e\u2018\u00ab\u00bb\u2012\u2013\u2014\u2212"
"""Quotation marks and dashes that a word processor or a web page puts in the place of the keyboard's."""


def _modules() -> dict[str, str]:
    """Word of the command line -> module, from the files of the folders."""
    folders = [info.name for info in pkgutil.iter_modules(benchmarks.commands.__path__) if info.ispkg]
    found = {}
    for folder in folders:
        home = import_module(f"benchmarks.commands.{folder}")
        for info in pkgutil.iter_modules(home.__path__):
            found[info.name.replace("_", "-")] = f"{home.__name__}.{info.name}"
    return dict(sorted(found.items()))


def _parser() -> _Parser:
    parser = _Parser(
        prog="oed",
        description="Optimal experiment design: which input is worth applying, how good an estimate can get, "
        "and what a model is missing.",
    )
    parser.add_argument("--version", action="version", version=f"oed {oed.__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for word, home in _modules().items():
        module = import_module(home)
        sub = subparsers.add_parser(
            word,
            help=module.HELP,
            description=module.HELP,
            epilog=f"example: {module.EXAMPLE}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.configure(sub)
        sub.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
        sub.add_argument("--seed", type=natural, default=0, help="seed of everything random (default 0)")
        sub.add_argument("--quiet", action="store_true", help="no progress on standard error")
        sub.set_defaults(run=module.run, options=sub.options())
    return parser


def plain(value: Any) -> Any:
    """A value as JSON knows it: arrays as lists, numbers that are not finite as null."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    listed = getattr(value, "tolist", None)
    if listed is not None:
        return plain(listed())
    if isinstance(value, int):
        return value
    if isinstance(value, complex):
        return [plain(value.real), plain(value.imag)]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)


BEYOND_ASCII = re.compile(r"[^\n\t -~]")


def _written_out(text: str) -> str:
    """Text in which characters that a terminal obeys and does not show are written out: names in files may have them."""
    shown = lambda hit: repr(hit[0])[1:-1] if unicodedata.category(hit[0])[0] == "C" else hit[0]
    return BEYOND_ASCII.sub(shown, text)


class _Lasting:
    """A stream of text that ends no work: where it can no longer be written to, the rest goes nowhere, and why is kept. What a
    terminal would obey is written out, but for what goes to `drawn`, where lines of progress are."""

    def __init__(self, stream: Any, drawn: bool = False) -> None:
        self.stream, self.failed = stream, None
        self.drawn = self if drawn else _Lasting(stream, drawn=True)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        self._tried(self.stream.write, text if self.drawn is self else _written_out(text))
        return len(text)

    def flush(self) -> None:
        self._tried(self.stream.flush)

    def _tried(self, work: Callable[..., Any], *arguments: str) -> None:
        try:
            work(*arguments)
        except OSError as error:
            self.failed = self.failed or error
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.stream.fileno())  # what is left in the buffer would fail again, at exit too
            os.close(nowhere)

    def check(self) -> None:
        """Raise why it failed, unless its reader has gone, who has enough of it."""
        if self.failed is not None and not isinstance(self.failed, BrokenPipeError):
            raise self.failed


@contextlib.contextmanager
def _lasting() -> Iterator[_Lasting]:
    """Standard output and standard error, those that there are, do not end the work while the block runs."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:  # as behind `>&-`: the next file that is opened would have its place
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115
    out, err = _Lasting(sys.stdout), _Lasting(sys.stderr)
    with contextlib.ExitStack() as stack:
        for stream, redirected in ((out, contextlib.redirect_stdout), (err, contextlib.redirect_stderr)):
            # or a file whose name is no text ends the work
            if isinstance(stream.stream, io.TextIOWrapper):
                stream.stream.reconfigure(errors="backslashreplace")
            stack.enter_context(redirected(stream))
            stack.callback(stream.flush)
        yield out


@contextlib.contextmanager
def _standard_output_reserved() -> Iterator[Any]:
    """Send everything that is written to file descriptor 1 to standard error; yield the real one."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(kept, "w", closefd=False) as out:
            yield out
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


LONGEST = 1500
"""Characters of a message, with all that a user gave repeated in it: some ten lines of a terminal."""


def _one_line(text: str) -> str:
    """A message as one line, not longer than it may be."""
    words = " ".join(text.split())
    if len(words) > LONGEST:
        words = f"{words[: LONGEST // 2]} ... {words[-LONGEST // 2 :]}"
    return _written_out(words)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    # Matrices of this size gain nothing from threads, and with one the last bits are the same whatever the cores.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    # What NumPy warns of is for programmers: tests make it an error, -W shows it.
    if argv is None and not sys.warnoptions:
        warnings.simplefilter("ignore", RuntimeWarning)
        os.environ["PYTHONWARNINGS"] = "ignore::RuntimeWarning"  # of workers too
    with _lasting() as out:
        try:
            with ended_by_signals():
                return _main(sys.argv[1:] if argv is None else argv, out)
        except KeyboardInterrupt as error:  # before there is a command that would say what is kept
            print(f"oed: {how(error)}.", file=sys.stderr)
            return 128 + getattr(error, "number", signal.SIGINT)
        finally:
            if argv is None:
                leave_in_peace()


def _main(argv: list[str], out: _Lasting) -> int:
    if sys.flags.optimize > 1:  # found out at the first page, after all runs
        print(
            "oed: run Python without -OO (PYTHONOPTIMIZE=2): libraries below need docstrings.",
            file=sys.stderr,
        )
        return 2
    parser = _parser()
    if not argv:
        parser.print_help()
        return 0
    if typeset := next((word for word in argv if word and {word[0], word[-1]} & set(TYPESET)), ""):
        said = f"oed: {typeset} has typographic quotation marks or dashes; type \", ' and - anew."
        print(_one_line(said), file=sys.stderr)
        return 2
    if not argv[0].startswith("-"):
        try:
            check_names(argv[:1], tuple(_modules()), "command")
        except InputError as error:
            print(_one_line(f"oed: {error}"), file=sys.stderr)
            return 2
    args, unknown = parser.parse_known_args(argv)
    if args.command is None:
        said = f"oed: {argv[0]} is not understood; give a command first, see oed --help."
        print(_one_line(said), file=sys.stderr)
        return 2
    if unknown:
        hint = _as_file(unknown[:1]) or near(unknown[0], args.options)
        if "inputs" in args and not unknown[0].startswith("-"):
            hint = " (several names are one word with commas: --inputs u1,u2)"
        said = f"oed {args.command}: {unknown[0]} is not understood{hint}; see oed {args.command} --help."
        print(_one_line(said), file=sys.stderr)
        return 2
    with _progress(args):
        return _run(args, out)


OWN_PROGRESS = ("compare", "diagnose-folder")
"""Commands that show more than the time by themselves."""


@contextlib.contextmanager
def _progress(args: argparse.Namespace) -> Iterator[None]:
    """Stage, elapsed and remaining of what takes long, on standard error."""
    waits = (
        args.command in OWN_PROGRESS
        or getattr(args, "serve", False)
        or getattr(args, "action", "") == "watch"
    )
    if args.quiet or waits:
        yield
        return
    from benchmarks.progress import shown

    with shown(args.command):
        yield


RESUMES = ("compare", "diagnose-folder", "session")
"""Commands that store each part of their work as it is finished; the others write once they have a result."""


def _ended(args: argparse.Namespace, error: KeyboardInterrupt) -> int:
    """Say that the command was ended and what there is of it; the exit status."""
    what = how(error)
    out = getattr(args, "out", None)
    if args.command in RESUMES:
        left = "what was finished is kept"
    elif out and os.path.isdir(out) and os.listdir(out):
        left = f"what {out} holds is not whole: remove it before the command is run again"
    else:
        left = "nothing of it is kept"
    print(_one_line(f"oed {args.command}: {what}; {left}."), file=sys.stderr)
    return 128 + getattr(error, "number", signal.SIGINT)


def _run(args: argparse.Namespace, out: _Lasting) -> int:
    try:
        if not args.json:
            _, text, *status = args.run(args)  # a status only where a command has one of its own
            print(text, flush=True)
        else:
            with _standard_output_reserved() as kept:
                content, _, *status = args.run(args)
                payload = {"schema_version": SCHEMA_VERSION, **content}
                out = _Lasting(kept)
                out.write(json.dumps(plain(payload), allow_nan=False) + "\n")
                out.flush()
        out.check()
        return status[0] if status else 0
    except OedError as error:
        print(f"oed {args.command}: {_one_line(str(error))}", file=sys.stderr)
        return 2 if isinstance(error, BAD_INPUT) else 1
    except KeyboardInterrupt as error:
        return _ended(args, error)
    except Exception as error:
        if stop := interruption(error):
            return _ended(args, stop)
        remedy = str(error) if isinstance(error, MissingExtra) else ""
        if isinstance(error, OSError):  # such as a name too long for a file, or a full disk behind `>`
            remedy = _one_line(
                f"{error.filename}: {error.strerror}; give another name"
                if error.filename is not None
                else f"reading or writing was refused by the system ({error.strerror or error}); make room, or write elsewhere"
            )
        if isinstance(error, MemoryError):
            remedy = f"there is not enough memory ({_one_line(str(error))}); ask for less"
        if remedy:
            print(f"oed {args.command}: {remedy}.", file=sys.stderr)
            return 2
        traceback.print_exc()
        print(
            f"oed {args.command}: this is a defect of oed {oed.__version__}, not of your input.",
            file=sys.stderr,
        )
        return 1


if __name__ == "__main__":
    raise SystemExit(main())
