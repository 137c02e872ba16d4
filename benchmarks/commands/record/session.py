"""`oed session`: experiments on a rig by files, one step at a time."""

import argparse
import json
import sys
import time
from math import isfinite, pi
from pathlib import Path
from typing import Any

from benchmarks.commands import natural
from estimators.sessions.settings import METHOD_NAMES

HELP = "experiments on a rig by files: start, rest, next, record, undo, watch, status, estimate"
EXAMPLE = "oed session start rig --method power --samples 1000 --dt 0.001 --amplitude 2"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the steps of a session, each with its options."""
    steps = parser.add_subparsers(dest="action", metavar="STEP", required=True)
    for name, (words, example, _) in STEPS.items():
        sub = steps.add_parser(
            name,
            help=words,
            description=words,
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        add = sub.add_argument
        # fmt: off
        add("folder", metavar="DIR", help="the session's folder")
        if name == "start":
            _configure_start(sub)
        elif name == "rest":
            add("file", metavar="FILE", nargs="?", help="what the rig wrote; without it the input is written")
            add("--share", type=float, metavar="s", help="height of the pulses over the largest input (default 0.1)")
        elif name == "status":
            add("--picture", metavar="FILE", help="draw it: .html (the page), .svg, .png or .pdf")
        elif name == "next":
            add("--reduce", action="store_true", help="halve it and all that follow (after an abort)")
        elif name == "record":
            add("file", metavar="FILE", help="CSV, MAT, Parquet or npz with the outputs' columns")
            add("--accept", action="store_true", help="use it although it looks saturated or held")
        elif name == "watch":
            add("inbox", metavar="INBOX", help="where the rig writes its outputs")
            add("--every", type=float, default=1.0, metavar="s", help="look that often (default 1)")
            add("--once", action="store_true", help="take what is there, and end")
        elif name == "estimate":
            add("--diagnose", action="store_true", help="say what is missing (in the model, if given)")
        add("--json", action="store_true", default=argparse.SUPPRESS, help="print one JSON object and nothing else")
        add("--quiet", action="store_true", default=argparse.SUPPRESS, help="no progress")
        add("--seed", type=natural, default=argparse.SUPPRESS, help="seed of everything random (default 0)")
        # fmt: on


AS_GIVEN = ("method", "samples", "dt", "experiments", "power", "amplitude", "rate", "energy", "lead", "ramp", "rest", "periods",
            "warm_up", "centre", "abort", "delay", "criterion", "scaling", "seed")  # fmt: skip
"""Settings that are the options of the same names."""


def _configure_start(sub: argparse.ArgumentParser) -> None:
    numbers = {"type": _numbers, "metavar": "X[,X..]"}
    add = sub.add_argument
    # fmt: off
    add("--method", required=True, choices=METHOD_NAMES,
        help="what chooses the next input: power iterations (power; of several channels procedure-2), a model fitted once (two-stage) or after "
        "every experiment (sequential), power moved to the loudest line (bandit), what the diagnosis cannot tell apart (diagnose-next)")
    add("--samples", type=int, required=True, metavar="N", help="samples of one experiment (or period)")
    add("--dt", type=float, required=True, metavar="s", help="sampling time in seconds")
    add("--experiments", type=int, default=20, help="budget (default 20)")
    add("--inputs", type=_names, default=("u",), metavar="NAMES", help="with units: force_N,torque_Nm")
    add("--outputs", type=_names, default=("y",), metavar="NAMES", help="with units: position_m")
    add("--power", type=float, metavar="P", help="mean square, summed over the inputs (default 1)")
    add("--amplitude", **numbers, help="largest deviation from the level, per input")
    add("--rate", **numbers, help="largest change per second, per input")
    add("--energy", **numbers, help="largest sum of squares over the samples, per input")
    add("--level", **numbers, help="operating level of each input (default 0)")
    add("--lead", type=int, default=0, metavar="n", help="samples at the level before, for the resting output")
    add("--ramp", type=int, default=0, metavar="n", help="samples in which the input comes in and goes out")
    add("--rest", type=int, default=0, metavar="n", help="samples at the level after each experiment")
    add("--periods", type=int, default=1, metavar="P", help="periods measured and averaged")
    add("--warm-up", type=int, default=0, metavar="P", help="periods discarded before them")
    add("--centre", action="store_true", help="take the mean off every output")
    add("--abort", **numbers, help="outputs beyond it are not used, per output")
    add("--range", type=_ranges, metavar="LOW:HIGH[,..]", help="sensor range, per output")
    add("--orders", type=int, nargs=2, default=(2, 2), metavar=("nb", "nf"), help="for two-stage, sequential")
    add("--delay", type=int, default=1, metavar="nk")
    add("--criterion", default="hinf", help="what two-stage and sequential minimise (default hinf)")
    add("--scaling", choices=("none", "each", "common"), default="each", help="for procedure-2")
    add("--model", metavar="MODEL.json", help="iterate on this model minus the rig")
    # fmt: on


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Do one step."""
    from estimators.sessions import open_session

    if args.action == "start":
        return _start(args)
    session = open_session(args.folder)
    for words in session.folder.damage():
        print(f"oed session: {words}", file=sys.stderr)
    return STEPS[args.action][2](args, session)


def _rest(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    from estimators.sessions.rest import ask_rest, record_rest

    if args.file is None:
        file = ask_rest(session, args.share)
        return _payload(session) | {"rest_input": str(file)}, (
            f"rest test: apply {file} (the input at its level, then a small pulse of each input)\n"
            f"then: oed session rest {args.folder} FILE"
        )
    record_rest(session, Path(args.file))
    payload, found = _stand(session)
    return payload, f"{_rest_words(session, found, payload)}\nnext: oed session next {args.folder}"


def _rest_words(session: Any, found: Any, payload: dict[str, Any]) -> str:
    if found is None:
        return f"no rest test yet: oed session rest {session.path} (noise, drift, gain and delay of the rig)"
    return "\n".join([*found.sentences(session.settings), *(f"warning: {w}." for w in payload["warnings"])])


def _next(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    from estimators.sessions.rest import next_warnings

    file = session.next_input(reduce=args.reduce)
    payload, found = _stand(session)
    if file is None:
        said = f"the session is finished: {payload['message']} See `oed session estimate {args.folder}`."
        return payload, said
    asked = session.asked()
    payload |= {"kind": asked.kind, "factor": asked.factor, "limit": asked.limit, "rows": len(asked.whole)}
    scaled = f", times {asked.factor:.4g} ({asked.limit})" if asked.limit else ""
    lines = [f"step {asked.step}: apply {file} ({asked.kind}{scaled})", _time_left(payload)]
    if found is not None:
        payload["warnings"] = next_warnings(found, session.settings, asked.whole)
        lines += [f"warning: {words}." for words in payload["warnings"]]
    elif asked.step == 1:
        lines.append(_rest_words(session, found, payload))
    return payload, "\n".join(lines)


def _record(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    step, file = session.record(args.file, accept=args.accept)
    payload = _payload(session) | {"recorded": step}
    return payload, f"step {step}: stored as {file}\n{session.estimate()}\n{_time_left(payload)}"


def _undo(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    asked = _payload(session)["input"]
    step, file = session.undo()
    payload = _payload(session) | {"undone": step}
    lines = [f"step {step} waits again for the output of {payload['input']}; the one taken back is {file}"]
    if asked:
        lines.append(
            f"do not apply {asked}, which was made from it: it is kept aside too; step {step + 1} gets another"
        )
    return payload, "\n".join(lines)


def _status(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    payload, found = _stand(session)
    waits = f"waits for the output of {payload['input']}" if payload["input"] else ""
    flagged = f"; {len(payload['flagged'])} flagged measurements" if payload["flagged"] else ""
    lines = [
        f"{session}: {waits or payload['message'] or 'ask for the next input'}{flagged}",
        _time_left(payload),
    ]
    lines += [str(session.estimate()), _rest_words(session, found, payload), *_sketch(payload["gains"])]
    if args.picture:
        from benchmarks.page.session import draw_session

        payload["picture"] = str(draw_session(session.path, Path(args.picture)))
        lines.append(f"picture: {payload['picture']}")
    return payload, "\n".join(lines)


def _estimate(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    payload, text = _payload(session), str(session.estimate())
    if args.diagnose:
        from estimators.sessions.diagnosis import diagnosis_of

        found = diagnosis_of(session)
        payload, text = payload | {"diagnosis": found.to_dict()}, f"{text}\n{found}"
    return payload, text


def _time_left(payload: dict[str, Any]) -> str:
    """The rate, and what the experiments that are left take at the least."""
    from benchmarks.progress import in_words

    left = payload["budget"] - payload["experiments"]
    return (
        f"{payload['rows']} rows at {payload['rate_hz']:.6g} Hz, {in_words(payload['seconds_each'])} each; "
        f"at most {left} left, {in_words(payload['seconds_left'])}"
    )


HEIGHT, WIDTH = 5, 60
"""Lines and columns of the sketch."""


def _sketch(values: list[float]) -> list[str]:
    """The method's own gains over the experiments, in characters that every terminal has."""
    known = [v for v in values[-WIDTH:] if isfinite(v)]
    if len(known) < 2:
        return []
    low, high = min(known), max(known)
    step = (high - low) / (HEIGHT - 1) or 1.0
    at = [round((v - low) / step) if isfinite(v) else -1 for v in values[-WIDTH:]]
    ends = {0: f"{low:.4g}", HEIGHT - 1: f"{high:.4g}"}
    lines = [
        f"{ends.get(k, ''):>10} |{''.join('*' if a == k else ' ' for a in at)}".rstrip()
        for k in range(HEIGHT)[::-1]
    ]
    return ["the method's own gain after every iteration, the last to the right:", *lines]


def _watch(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    """Record each new file of a folder once it no longer grows, and ask for the next input."""
    from oed.errors import InputError

    inbox = Path(args.inbox)
    if not inbox.is_dir():
        raise InputError(f"{inbox} is no folder; make it, and let the rig write its outputs there.")
    sizes: dict[tuple[str, int], int] = {}
    taken: set[tuple[str, int]] = set()
    said = []
    while session.next_input() is not None:
        found = {(p.name, p.stat().st_mtime_ns): p for p in inbox.iterdir() if p.is_file()}
        whole = [k for k, p in found.items() if args.once or sizes.get(k) == p.stat().st_size]
        new = sorted(set(whole) - taken, key=lambda key: key[1])
        sizes = {k: p.stat().st_size for k, p in found.items()}
        for key in new:
            taken.add(key)
            try:
                step, _ = session.record(found[key])
                words = f"step {step}: {key[0]} is stored; next: {session.next_input() or 'nothing, the session is finished'}"
            except InputError as error:
                words = f"{key[0]} is not used: {error}"
            said.append(words)
            if not args.quiet:
                print(words, file=sys.stderr, flush=True)
            if session.step is None:
                break
        if args.once:
            break
        time.sleep(args.every)
    return _payload(session) | {"events": said}, str(session.estimate())


def _start(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    from estimators.sessions import Settings, start_session
    from oed.errors import InputError
    from oed.files.tables import split_unit

    model = None
    if args.model is not None:
        from oed.plants.json import plant_from_json, plant_to_json

        model = json.loads(json.dumps(plant_to_json(plant_from_json(args.model))))
    inputs, outputs = ([split_unit(name) for name in side] for side in (args.inputs, args.outputs))
    if Path(args.folder).is_file():
        raise InputError(f"{args.folder} is a file; give a folder for the session.")
    settings = Settings(
        inputs=tuple(n for n, _ in inputs), outputs=tuple(n for n, _ in outputs),
        input_units=tuple(unit for _, unit in inputs), output_units=tuple(unit for _, unit in outputs),
        level=args.level or (), sensor_range=args.range, orders=tuple(args.orders), model=model,
        **{name: getattr(args, name) for name in AS_GIVEN},
    )  # fmt: skip
    session = start_session(args.folder, settings)
    payload, found = _stand(session)
    return payload, f"{session}\n{_rest_words(session, found, payload)}\nnext: oed session next {args.folder}"


def _payload(session: Any) -> dict[str, Any]:
    """The keys of every step."""
    return _stand(session)[0]


def _stand(session: Any) -> tuple[dict[str, Any], Any]:
    """The keys of every step, and the rest test, which is read and analysed once."""
    from estimators.sessions.layout import rig_samples
    from estimators.sessions.rest import rest_of

    estimate, s, status, rest = session.estimate(), session.settings, session.status(), rest_of(session)
    rows = rig_samples(s)
    payload = status | {
        "rows": rows, "rate_hz": 1 / s.dt, "seconds_each": rows * s.dt,
        "seconds_left": rows * s.dt * (status["budget"] - status["experiments"]),
        "rest": None if rest is None else rest.to_dict(),
        "warnings": [] if rest is None else rest.warnings(s),
        "estimate": estimate.value, "standard_error": estimate.standard_error, "interval": list(estimate.interval),
        **_frequency(estimate, 2 * pi * session.settings.dt),
        "direction": [[float(d.real), float(d.imag)] for d in estimate.direction],
        "estimator": estimate.estimator, "estimate_status": estimate.status.name, "estimate_message": estimate.message,
        "gains": list(estimate.gains), "noise_floor": list(estimate.noise_floor),
    }  # fmt: skip
    return payload, rest


def _frequency(estimate: Any, per_hertz: float) -> dict[str, Any]:
    """Null where the records do not say where the peak is, so that nobody takes the place looked at for it."""
    known = isfinite(estimate.frequency_error)
    return {
        "frequency": estimate.frequency if known else None,
        "frequency_error": estimate.frequency_error if known else None,
        "frequency_hz": estimate.frequency / per_hertz if known else None,
    }


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _ranges(text: str) -> tuple[tuple[float, float], ...]:
    low_high = [part.split(":") for part in text.split(",")]
    return tuple((float(low), float(high)) for low, high in low_high)


STEPS = {
    "start": ("start a session in a folder", EXAMPLE, None),
    "rest": (
        "test the rig at rest and by a small pulse: noise, drift, gain, delay; with FILE store what was measured",
        "oed session rest rig measured.csv",
        _rest,
    ),
    "next": ("write the next input for the rig", "oed session next rig", _next),
    "record": ("check and store what was measured", "oed session record rig output.csv", _record),
    "undo": ("take the last output back; it is kept aside", "oed session undo rig", _undo),
    "watch": (
        "take the files of a folder as they come, until the session ends",
        "oed session watch rig inbox",
        _watch,
    ),
    "status": ("where the session stands", "oed session status rig --picture status.svg", _status),
    "estimate": ("the estimate so far, with its uncertainty", "oed session estimate rig --json", _estimate),
}
