"""What a session is about: method, channels, lengths, limits. Written once, as JSON that a person can read."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from oed.errors import CUBES, CampaignError, InputError, check_names, check_sampling_time, check_size
from oed.files.documents import FLAG, NUMBER, TEXT, WHOLE, checked, keyed, parsed_json

SCHEMA = 1
METHOD_NAMES = ("power", "procedure-2", "two-stage", "sequential", "bandit", "diagnose-next")
ONE_CHANNEL = ("power", "bandit", "diagnose-next")
MOST = 10**7
"""Numbers in a file of a session, and of anything else that is counted: files of more are larger than is read, and fill the memory."""


@dataclass(frozen=True)
class Settings:
    """The settings of a session on a rig.

    Attributes
    ----------
    method : str
        One of `METHOD_NAMES`.
    samples : int
        N of the method: one period where periods are repeated.
    dt : float
        Sampling time in seconds.
    experiments : int
        Budget.
    inputs, outputs : tuple of str
        Names of the channels.
    input_units, output_units : tuple of str
        Their units, empty strings where unknown.
    power : float or None
        Largest sum over the inputs of their mean squares; 1 if nothing else limits the inputs.
    amplitude, rate, energy : tuple of float or None
        Per input: largest deviation from its level; largest change per second; largest sum over samples of
        squared deviations.
    level : tuple of float
        Operating level of each input: the rig is there when an experiment begins.
    lead : int
        Samples at the level before every experiment: the mean output of their second half is the resting output,
        and is taken off.
    ramp : int
        Samples in which the input comes in and goes out.
    rest : int
        Samples at the level that follow every experiment.
    periods, warm_up : int
        Periods measured and averaged; periods before them that are discarded. More than one period in all
        makes the experiment periodic, otherwise it starts from rest.
    centre : bool
        Whether the mean of every output is taken off (the gain at frequency 0 is then not seen).
    abort : tuple of float or None
        Per output: a measurement with a larger absolute value is not used.
    sensor_range : tuple of tuple or None
        Per output: lowest and highest reading; samples there are saturated.
    reference_tolerance : float
        Largest relative deviation of a recorded input from the one asked for.
    orders : tuple of int
        Output-error orders nb, nf of two-stage and sequential, of every entry where there are several channels.
    delay : int
        Their delay in samples.
    criterion : str
        What their designs minimise.
    scaling : str
        Scaling of the second-stage inputs of procedure-2.
    seed : int
        Of everything random.
    model : dict or None
        A plant as in `oed.plants.json`: the iterations then run on model minus rig.
    """

    method: str
    samples: int
    dt: float = 1.0
    experiments: int = 20
    inputs: tuple[str, ...] = ("u",)
    outputs: tuple[str, ...] = ("y",)
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    power: float | None = None
    amplitude: tuple[float, ...] | None = None
    rate: tuple[float, ...] | None = None
    energy: tuple[float, ...] | None = None
    level: tuple[float, ...] = ()
    lead: int = 0
    ramp: int = 0
    rest: int = 0
    periods: int = 1
    warm_up: int = 0
    centre: bool = False
    abort: tuple[float, ...] | None = None
    sensor_range: tuple[tuple[float, float], ...] | None = None
    reference_tolerance: float = 0.05
    orders: tuple[int, ...] = (2, 2)
    delay: int = 1
    criterion: str = "hinf"
    scaling: str = "each"
    seed: int = 0
    model: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        check_names([self.method], METHOD_NAMES, "session method")
        for name in ("inputs", "outputs", "input_units", "output_units", "level", "orders"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for side in ("input", "output"):
            if not getattr(self, f"{side}_units"):
                object.__setattr__(self, f"{side}_units", ("",) * len(getattr(self, f"{side}s")))
        _check_channels(self)
        for name, least in (("samples", 4), ("experiments", 1), ("lead", 0), ("ramp", 0), ("rest", 0), ("periods", 1),
                            ("warm_up", 0), ("delay", 0), ("seed", 0)):  # fmt: skip
            value = getattr(self, name)
            most = np.inf if name == "seed" else MOST
            if (
                isinstance(value, bool)
                or not isinstance(value, int | np.integer)
                or not least <= value <= most
            ):
                raise InputError(f"{name} is {value!r}; it must be a whole number from {least} to {most:,}.")
            object.__setattr__(self, name, int(value))
        check_sampling_time(self.dt, MOST**2)  # the longest session's length is a number
        check_size("the sampling time", self.dt, CUBES)
        numbers = (
            self.samples * (self.periods + self.warm_up) + 2 * self.ramp + self.lead + self.rest
        ) * max(self.n_inputs, self.n_outputs)
        if numbers > MOST:
            raise InputError(
                f"each file would hold {numbers:,} numbers and at most {MOST:,} are used; ask for shorter experiments or fewer periods."
            )
        if 2 * self.ramp > self.samples:
            raise InputError(
                f"the ramps of {self.ramp} samples each do not fit into {self.samples} samples; shorten them."
            )
        if not 0 < self.reference_tolerance < 1:
            raise InputError(
                f"reference_tolerance is {self.reference_tolerance}; it is a share between 0 and 1."
            )
        object.__setattr__(self, "level", self.level or (0.0,) * self.n_inputs)
        for name, channels in (("amplitude", self.inputs), ("rate", self.inputs), ("energy", self.inputs),
                               ("abort", self.outputs)):  # fmt: skip
            object.__setattr__(self, name, _per_channel(getattr(self, name), channels, name))
        _check_levels_and_ranges(self)
        if self.power is None and self.amplitude is None and self.energy is None:
            object.__setattr__(self, "power", 1.0)
        if self.power is not None and not (np.isfinite(self.power) and self.power > 0):
            raise InputError(f"the power is {self.power}; it must be positive and finite.")
        check_size("the root of the power", (self.power or 0.0) ** 0.5, CUBES)
        for name in ("amplitude", "energy"):
            for limit in getattr(self, name) or ():
                check_size(f"the limit {name}", limit if name == "amplitude" else limit**0.5, CUBES)
        check_names([self.scaling], ("none", "each", "common"), "scaling")
        if len(self.orders) != 2 or min(self.orders) < 0:
            raise InputError(f"orders is {self.orders}; give nb and nf of an output-error model.")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def entry_orders(self) -> Any:
        """The orders as `identify` takes them: two numbers, or two tables with a row per output."""
        if self.n_inputs * self.n_outputs == 1:
            return self.orders
        return tuple([[order] * self.n_inputs for _ in self.outputs] for order in self.orders)

    @property
    def periodic(self) -> bool:
        """Whether periods are repeated."""
        return self.periods + self.warm_up > 1


def _check_channels(s: Settings) -> None:
    for side in ("input", "output"):
        names, units = getattr(s, f"{side}s"), getattr(s, f"{side}_units")
        if not names or not all(isinstance(name, str) and name.strip() for name in names):
            raise InputError(f"the {side}s are {list(names)}; name at least one channel.")
        if len(units) != len(names):
            raise InputError(f"{len(units)} {side} units for {len(names)} {side}s; give one per channel.")
    names = [*s.inputs, *s.outputs]
    if len(set(names)) < len(names) or {"t", "t_s"} & set(names):
        raise InputError(
            f"the channels are {names}; every name must be given once, and t and t_s are the time."
        )
    if s.method in ONE_CHANNEL and (s.n_inputs, s.n_outputs) != (1, 1):
        raise InputError(
            f"the method {s.method} needs one input and one output, and {s.n_inputs} and {s.n_outputs} are named; "
            "use procedure-2."
        )


def _check_levels_and_ranges(s: Settings) -> None:
    if len(s.level) != s.n_inputs or not np.isfinite(s.level).all():
        raise InputError(f"the level is {s.level}; give one finite number per input.")
    object.__setattr__(s, "level", tuple(map(float, s.level)))
    if s.sensor_range is None:
        return
    ranges = tuple(tuple(map(float, pair)) for pair in s.sensor_range)
    if len(ranges) != s.n_outputs or any(len(p) != 2 or not p[0] < p[1] for p in ranges):
        raise InputError(f"the sensor range is {ranges}; give a lowest and a highest reading per output.")
    object.__setattr__(s, "sensor_range", ranges)


def _per_channel(value: Any, channels: tuple[str, ...], name: str) -> tuple[float, ...] | None:
    """One positive number per channel; a single one counts for all."""
    if value is None:
        return None
    given = tuple(float(v) for v in np.atleast_1d(np.asarray(value, dtype=float)))
    given = given * len(channels) if len(given) == 1 else given
    if len(given) != len(channels) or not all(np.isfinite(v) and v > 0 for v in given):
        raise InputError(
            f"the limit {name} is {value}; give one positive number for all channels or one for each of "
            f"{', '.join(channels)}."
        )
    return given


def _or_null(kind: dict[str, Any]) -> dict[str, Any]:
    return {"anyOf": [kind, {"type": "null"}], "description": f"{kind['description']}, or null"}


def _list_of(kind: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": kind, "description": f"a list, each entry {kind['description']}"}


SESSION = keyed(
    {
        **dict.fromkeys(("method", "criterion", "scaling"), TEXT),
        **dict.fromkeys(
            ("samples", "experiments", "lead", "ramp", "rest", "periods", "warm_up", "delay", "seed"), WHOLE
        ),
        **dict.fromkeys(("dt", "reference_tolerance"), NUMBER),
        **dict.fromkeys(("inputs", "outputs", "input_units", "output_units"), _list_of(TEXT)),
        "power": _or_null(NUMBER),
        **dict.fromkeys(("amplitude", "rate", "energy", "abort"), _or_null(_list_of(NUMBER))),
        "level": _list_of(NUMBER),
        "orders": _list_of(WHOLE),
        "centre": FLAG,
        "sensor_range": _or_null(_list_of(_list_of(NUMBER))),
        "model": _or_null({"type": "object", "description": "a plant"}),
    },
    ("method", "samples"),
)
"""What session.json holds beside its version."""


def settings_to_json(settings: Settings) -> str:
    """The text of `session.json`."""
    return json.dumps({"oed_session": SCHEMA, **asdict(settings)}, indent=1) + "\n"


def settings_from_json(text: str, where: str) -> Settings:
    """Settings from the text of `session.json`."""
    content = parsed_json(text, where, error=CampaignError)
    if not isinstance(content, Mapping) or "oed_session" not in content:
        raise CampaignError(f"{where} does not describe a session; choose another folder.")
    content = dict(content)
    schema = content.pop("oed_session")
    if schema != SCHEMA:
        raise CampaignError(
            f"{where} was written by another version (sessions of version {schema!r}, this is {SCHEMA}); "
            "go on with that version."
        )
    checked(content, SESSION, where, error=CampaignError)
    try:
        return Settings(**{k: _tupled(v) if k != "model" else v for k, v in content.items()})
    except (InputError, TypeError, ValueError) as error:
        raise CampaignError(f"{where} is damaged: {error}") from None


def _tupled(value: Any) -> Any:
    return tuple(_tupled(v) for v in value) if isinstance(value, list) else value
