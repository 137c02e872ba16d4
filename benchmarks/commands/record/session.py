"""`oed session`: experiments on a rig by files, one step at a time."""

from __future__ import annotations

import argparse
from math import isfinite, pi
from typing import Any

HELP = "experiments on a rig by files: start, next, record, status, estimate"
EXAMPLE = "oed session start rig --method power --samples 1000 --dt 0.001 --amplitude 2"
METHODS = ("power", "procedure-2", "two-stage", "sequential", "bandit", "diagnose-next")
STEPS = {
    "start": ("start a session in a folder", EXAMPLE),
    "next": ("write the next input for the rig", "oed session next rig"),
    "record": ("check and store what was measured", "oed session record rig output.csv"),
    "undo": ("take the last output back; it is kept aside", "oed session undo rig"),
    "watch": (
        "take the files of a folder as they come, until the session ends",
        "oed session watch rig inbox",
    ),
    "status": ("where the session stands", "oed session status rig"),
    "estimate": ("the estimate so far, with its uncertainty", "oed session estimate rig --json"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the steps of a session, each with its options."""
    steps = parser.add_subparsers(dest="action", metavar="STEP", required=True)
    for name, (words, example) in STEPS.items():
        sub = steps.add_parser(
            name,
            help=words,
            description=words,
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.add_argument("folder", metavar="DIR", help="the session's folder")
        if name == "start":
            _configure_start(sub)
        elif name == "next":
            sub.add_argument(
                "--reduce", action="store_true", help="halve it and all that follow (after an abort)"
            )
        elif name == "record":
            sub.add_argument(
                "file", metavar="FILE", help="CSV, MAT, Parquet or npz with the outputs' columns"
            )
            sub.add_argument(
                "--accept", action="store_true", help="use it although it looks saturated or held"
            )
        elif name == "watch":
            sub.add_argument("inbox", metavar="INBOX", help="where the rig writes its outputs")
            sub.add_argument(
                "--every", type=float, default=1.0, metavar="s", help="look that often (default 1)"
            )
            sub.add_argument("--once", action="store_true", help="take what is there, and end")
        elif name == "estimate":
            sub.add_argument(
                "--diagnose", action="store_true", help="say what is missing (in the model, if given)"
            )
        for option, words in (
            ("--json", "print one JSON object and nothing else"),
            ("--quiet", "no progress"),
        ):
            sub.add_argument(option, action="store_true", default=argparse.SUPPRESS, help=words)
        sub.add_argument(
            "--seed", type=int, default=argparse.SUPPRESS, help="seed of everything random (default 0)"
        )


def _configure_start(sub: argparse.ArgumentParser) -> None:
    numbers = {"type": _numbers, "metavar": "X[,X..]"}
    sub.add_argument("--method", required=True, choices=METHODS)
    sub.add_argument(
        "--samples", type=int, required=True, metavar="N", help="samples of one experiment (or period)"
    )
    sub.add_argument("--dt", type=float, required=True, metavar="s", help="sampling time in seconds")
    sub.add_argument("--experiments", type=int, default=20, help="budget (default 20)")
    sub.add_argument(
        "--inputs", type=_names, default=("u",), metavar="NAMES", help="with units: force_N,torque_Nm"
    )
    sub.add_argument("--outputs", type=_names, default=("y",), metavar="NAMES", help="with units: position_m")
    sub.add_argument(
        "--power", type=float, metavar="P", help="mean square, summed over the inputs (default 1)"
    )
    sub.add_argument("--amplitude", **numbers, help="largest deviation from the level, per input")
    sub.add_argument("--rate", **numbers, help="largest change per second, per input")
    sub.add_argument("--energy", **numbers, help="largest sum of squares over the samples, per input")
    sub.add_argument("--level", **numbers, help="operating level of each input (default 0)")
    sub.add_argument(
        "--lead", type=int, default=0, metavar="n", help="samples at the level before, for the resting output"
    )
    sub.add_argument(
        "--ramp", type=int, default=0, metavar="n", help="samples in which the input comes in and goes out"
    )
    sub.add_argument(
        "--rest", type=int, default=0, metavar="n", help="samples at the level after each experiment"
    )
    sub.add_argument("--periods", type=int, default=1, metavar="P", help="periods measured and averaged")
    sub.add_argument("--warm-up", type=int, default=0, metavar="P", help="periods discarded before them")
    sub.add_argument("--centre", action="store_true", help="take the mean off every output")
    sub.add_argument("--abort", **numbers, help="outputs beyond it are not used, per output")
    sub.add_argument("--range", type=_ranges, metavar="LOW:HIGH[,..]", help="sensor range, per output")
    sub.add_argument(
        "--orders", type=int, nargs=2, default=(2, 2), metavar=("nb", "nf"), help="for two-stage, sequential"
    )
    sub.add_argument("--delay", type=int, default=1, metavar="nk")
    sub.add_argument(
        "--criterion", default="hinf", help="what two-stage and sequential minimise (default hinf)"
    )
    sub.add_argument("--scaling", choices=("none", "each", "common"), default="each", help="for procedure-2")
    sub.add_argument("--model", metavar="MODEL.json", help="iterate on this model minus the rig")


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Do one step."""
    from estimators.sessions import open_session

    if args.action == "start":
        return _start(args)
    session = open_session(args.folder)
    if args.action == "next":
        file = session.next_input(reduce=args.reduce)
        payload = _payload(session)
        if file is None:
            return (
                payload,
                f"the session is finished: {payload['message']} See `oed session estimate {args.folder}`.",
            )
        asked = session.session.asked()
        payload |= {
            "kind": asked.kind,
            "factor": asked.factor,
            "limit": asked.limit,
            "rows": len(asked.whole),
        }
        scaled = f", times {asked.factor:.4g} ({asked.limit})" if asked.limit else ""
        return (
            payload,
            f"step {asked.step}: apply {file} ({asked.kind}{scaled})\n{_time_left(session, payload)}",
        )
    if args.action == "record":
        step, file = session.record(args.file, accept=args.accept)
        payload = _payload(session) | {"recorded": step}
        return payload, f"step {step}: stored as {file}\n{_estimate(session, payload)}"
    if args.action == "undo":
        step, file = session.undo()
        return _payload(session) | {
            "undone": step
        }, f"step {step} waits again for its output; the one taken back is {file}"
    if args.action == "watch":
        return _watch(args, session)
    payload = _payload(session)
    if args.action == "status":
        left = (
            f"waits for the output of {payload['input']}"
            if payload["input"]
            else payload["message"] or "ask for the next input"
        )
        flagged = f"; {len(payload['flagged'])} flagged measurements" if payload["flagged"] else ""
        return (
            payload,
            f"{session}: {left}{flagged}\n{_time_left(session, payload)}\n{_estimate(session, payload)}",
        )
    text = _estimate(session, payload)
    if args.diagnose:
        found, words = _diagnosis(session)
        payload, text = payload | found, f"{text}\n{words}"
    return payload, text


def _estimate(session: Any, payload: dict[str, Any]) -> str:
    hertz = payload["frequency_hz"]
    return f"{session.estimate()}" + (f" ({hertz:.4g} Hz)" if hertz is not None else "")


def _time_left(session: Any, payload: dict[str, Any]) -> str:
    """The rate, and what the experiments that are left take at the least."""
    from estimators.sessions.layout import rig_samples

    rows, dt = rig_samples(session.settings), session.settings.dt
    left = payload["budget"] - payload["experiments"]
    return f"{rows} rows at {1 / dt:.6g} Hz, {rows * dt:.4g} s each; at most {left} left, {left * rows * dt:.4g} s"


def _watch(args: argparse.Namespace, session: Any) -> tuple[dict[str, Any], str]:
    """Record each new file of a folder once it no longer grows, and ask for the next input."""
    import sys
    import time
    from pathlib import Path

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
    payload = _payload(session)
    return payload | {"events": said}, _estimate(session, payload)


def _start(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    import json
    from pathlib import Path

    from estimators.sessions import Settings, start_session
    from oed.errors import InputError
    from oed.files.tables import split_unit

    model = None
    if args.model is not None:
        from oed.plants.json import plant_from_json, plant_to_json

        model = plant_to_json(plant_from_json(args.model))
        model = json.loads(json.dumps(model))
    inputs, outputs = ([split_unit(name) for name in side] for side in (args.inputs, args.outputs))
    if Path(args.folder).is_file():
        raise InputError(f"{args.folder} is a file; give a folder for the session.")
    settings = Settings(
        method=args.method, samples=args.samples, dt=args.dt, experiments=args.experiments,
        inputs=tuple(n for n, _ in inputs), outputs=tuple(n for n, _ in outputs),
        input_units=tuple(unit for _, unit in inputs), output_units=tuple(unit for _, unit in outputs),
        power=args.power, amplitude=args.amplitude, rate=args.rate, energy=args.energy, level=args.level or (),
        lead=args.lead, ramp=args.ramp, rest=args.rest, periods=args.periods, warm_up=args.warm_up, centre=args.centre,
        abort=args.abort, sensor_range=args.range, orders=tuple(args.orders), delay=args.delay,
        criterion=args.criterion, scaling=args.scaling, seed=args.seed, model=model,
    )  # fmt: skip
    session = start_session(args.folder, settings)
    return _payload(session), f"{session}\nnext: oed session next {args.folder}"


def _payload(session: Any) -> dict[str, Any]:
    """The keys of every step."""
    estimate = session.estimate()
    return session.status() | {
        "estimate": estimate.value,
        "standard_error": estimate.standard_error,
        "interval": list(estimate.interval),
        **_frequency(estimate, 2 * pi * session.settings.dt),
        "direction": [[float(d.real), float(d.imag)] for d in estimate.direction],
        "estimator": estimate.estimator,
        "estimate_status": estimate.status.name,
        "estimate_message": estimate.message,
        "gains": list(estimate.gains),
        "noise_floor": list(estimate.noise_floor),
    }


def _frequency(estimate: Any, per_hertz: float) -> dict[str, Any]:
    """Null where the records do not say where the peak is, so that nobody takes the place looked at for it."""
    known = isfinite(estimate.frequency_error)
    return {
        "frequency": estimate.frequency if known else None,
        "frequency_error": estimate.frequency_error if known else None,
        "frequency_hz": estimate.frequency / per_hertz if known else None,
    }


def _diagnosis(session: Any) -> tuple[dict[str, Any], str]:
    from estimators.sessions.diagnosis import diagnosis_of

    found = diagnosis_of(session.session)
    return {"diagnosis": found.to_dict()}, str(found)


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _ranges(text: str) -> tuple[tuple[float, float], ...]:
    low_high = [part.split(":") for part in text.split(",")]
    return tuple((float(low), float(high)) for low, high in low_high)
