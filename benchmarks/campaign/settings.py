"""What decides the numbers of a campaign, from Python, the command line or a TOML file."""

import fnmatch
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign.plants import check_plants, content_of
from benchmarks.campaign.registry import ESTIMATORS, METHODS
from oed.errors import InputError, check_names
from oed.files.documents import NUMBER, TEXT, WHOLE, keyed, listed, read_document
from oed.files.writing import in_text


@dataclass(frozen=True)
class Limit:
    """At most so many replicates of what is named; what is not named matches everything. `replicates` the
    most; 0 leaves it out; `plant, method, estimator` names, "" for any, and of plants a pattern such as
    `random-*`; `noise_variance` that level, 0 for any; `why` the reason, which tables repeat and which decides
    no number. With an estimator only its estimates are limited, not the runs."""

    replicates: int
    plant: str = ""
    method: str = ""
    estimator: str = ""
    noise_variance: float = 0.0
    why: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if self.replicates < 0:
            raise InputError(f"a limit has {self.replicates} replicates; it must be at least 0.")
        if not 0 <= self.noise_variance < np.inf:
            raise InputError(
                f"a limit has noise variance {self.noise_variance:g}; give one that is positive and finite."
            )


@dataclass(frozen=True)
class Settings:
    """What decides the numbers of a campaign. `plants` names or files; `noise_variances` for every plant (for
    hair-dryer in multiples of the identified variance); `methods, estimators` names, or `FILE.py:FUNCTION`
    for one's own; pairs that do not fit are left out; `samples, experiments` N of every experiment, and how
    many; `seed` of everything random; `profile_replicates` for so many replicates the estimators are also run
    after every checkpoint of the budget; `limits` what has fewer replicates than the rest; `sources` name and
    digest of the source of one's own methods and estimators; `contents` name and digest of every plant file,
    as it is when the settings are made, whatever is given."""

    plants: tuple[str, ...] = ("reference", "hair-dryer", "random-fir-1", "three-by-two")
    noise_variances: tuple[float, ...] = (1.0, 4.0, 9.0)
    methods: tuple[str, ...] = (
        "white", "multisine", "power", "procedure-2", "sequential", "sequential-selected", "oracle-D", "oracle-hinf",
    )  # fmt: skip
    estimators: tuple[str, ...] = (
        "rayleigh", "gain", "mu", "corrected", "fir-selected", "fir-regularised", "pem", "pem-selected",
    )  # fmt: skip
    samples: int = 1000
    experiments: int = 20
    seed: int = 0
    profile_replicates: int = 3
    limits: tuple[Limit, ...] = ()
    sources: tuple[tuple[str, str], ...] = field(default=(), repr=False)
    contents: tuple[tuple[str, str], ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        own = {name for name, _ in self.sources}
        check_plants(self.plants)
        check_names([m for m in self.methods if m not in own], tuple(METHODS), "method")
        check_names([e for e in self.estimators if e not in own], tuple(ESTIMATORS), "estimator")
        for name, least in (("samples", 10), ("experiments", 1), ("profile_replicates", 0)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or value < least:
                raise InputError(f"{name} is {value!r}; it must be a whole number of at least {least}.")
        for variance in self.noise_variances:
            if not (np.isfinite(variance) and variance > 0):
                raise InputError(
                    f"the noise variance is {variance:g}; a comparison needs positive, finite ones."
                )
        for name in (*self.plants, *self.methods, *self.estimators):
            if in_text(name) != name:
                raise InputError(
                    f"{name} is a file whose name is no text (UTF-8), and tables are to name it: rename the file."
                )
        for name in ("plants", "noise_variances", "methods", "estimators"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise InputError(f"{name} is {values}; give at least one, and each once.")
        contents = tuple((plant, digest) for plant in self.plants if (digest := content_of(plant)))
        object.__setattr__(self, "contents", contents)
        for limit in self.limits:
            for kind in ("plant", "method", "estimator"):
                wanted = getattr(limit, kind)
                if not (kind == "plant" and fnmatch.filter(self.plants, wanted)):
                    check_names([wanted] if wanted else [], getattr(self, f"{kind}s"), f"{kind} of a limit")

    def replicates_of(
        self, replicates: int, plant: str, method: str, estimator: str = "", noise_variance: float = 0.0
    ) -> int:
        """How many replicates a combination has; of an estimate where an estimator is named."""
        concerned = self._limits_of(plant, method, estimator, noise_variance)
        return min([replicates, *(limit.replicates for limit in concerned)])

    def why_not(self, plant: str, method: str, estimator: str = "", noise_variance: float = 0.0) -> str:
        """The reason for which a combination is left out, where its limit has one."""
        concerned = self._limits_of(plant, method, estimator, noise_variance)
        return next((limit.why for limit in concerned if limit.replicates == 0 and limit.why), "")

    def _limits_of(self, plant: str, method: str, estimator: str, noise_variance: float) -> list[Limit]:
        return [
            limit
            for limit in self.limits
            if limit.method in ("", method)
            and limit.noise_variance in (0.0, noise_variance)
            and limit.estimator in ("", estimator)
            and (not limit.plant or fnmatch.fnmatchcase(plant, limit.plant))
        ]

    def deciding(self) -> dict[str, Any]:
        """What a store is bound to: everything here but the reasons of limits."""
        values = asdict(self)
        for limit in values["limits"]:
            del limit["why"]
        return values


TWICE = "one channel: Procedure 2 is the power iterations twice over"

DEFAULT_LIMITS = (
    Limit(10, plant="three-by-two"),
    Limit(40, plant="random-fir-1"),
    Limit(40, plant="hair-dryer"),
    Limit(0, plant="reference", method="procedure-2", why=TWICE),
    Limit(0, plant="hair-dryer", method="procedure-2", why=TWICE),
    Limit(0, plant="random-fir-1", method="procedure-2", why=TWICE),
    Limit(40, method="sequential"),
    Limit(16, method="sequential-selected"),
    Limit(60, estimator="pem"),
    Limit(60, estimator="corrected"),
    Limit(60, estimator="fir-selected"),
    Limit(30, estimator="fir-regularised"),
    Limit(16, estimator="pem-selected"),
    Limit(6, plant="three-by-two", method="sequential-selected"),
    Limit(6, plant="three-by-two", estimator="pem-selected"),
)
"""Of a comparison that sets none: fits that choose their orders, of one or of six transfer functions, would take most of its
time. Each limit is what a minute of one core allows; the column "runs" of every table says it."""


def default_limits(
    plants: Sequence[str], methods: Sequence[str], estimators: Sequence[str]
) -> tuple[Limit, ...]:
    """The default limits that concern a comparison."""
    return tuple(
        limit
        for limit in DEFAULT_LIMITS
        if (not limit.plant or fnmatch.filter(plants, limit.plant))
        and limit.method in ("", *methods)
        and limit.estimator in ("", *estimators)
        and (limit.plant or limit.method or len(plants) > 1)
    )


LIMIT = keyed(
    {
        "replicates": WHOLE,
        "plant": TEXT,
        "method": TEXT,
        "estimator": TEXT,
        "noise_variance": NUMBER,
        "why": TEXT,
    },
    ("replicates",),
)
CAMPAIGN = keyed(
    {
        **dict.fromkeys(("plants", "methods", "estimators"), listed(TEXT, "texts")),
        "noise_variances": listed(NUMBER, "numbers"),
        **dict.fromkeys(("samples", "experiments", "seed", "profile_replicates", "replicates"), WHOLE),
        "time_limit": NUMBER,
        "out": TEXT,
        "limit": listed(LIMIT, "tables [[limit]]"),
    }
)
"""What a campaign file may hold."""


def campaign_from_toml(file: str | Path) -> dict[str, Any]:
    """The arguments of `compare` that a TOML file holds."""
    content = read_document(Path(file), CAMPAIGN, "the campaign file")
    found = {
        key: tuple(value) if isinstance(value, list) else _whole(key, value) for key, value in content.items()
    }
    for key in ("methods", "estimators"):
        found |= {key: tuple(_beside(Path(file), name) for name in found[key])} if key in found else {}
    if "limit" in found:
        entries = found.pop("limit")
        found["limits"] = tuple(Limit(**{k: _whole(k, v) for k, v in entry.items()}) for entry in entries)
    return found


def _whole(key: str, value: Any) -> Any:
    """1e3 is a whole number to a schema, and a float to TOML."""
    return int(value) if CAMPAIGN["properties"].get(key, {}).get("type") == "integer" else value


def _beside(campaign: Path, name: str) -> str:
    """One's own FILE.py:FUNCTION of a campaign file, where it lies beside it: a campaign from somebody else, on its own,
    runs nothing but what came with it."""
    if ".py:" not in name:
        return name
    code, _, function = name.rpartition(":")
    path = campaign.parent / code
    if path.resolve().parent != campaign.resolve().parent:
        raise InputError(
            f"the campaign file {campaign} asks to run {code}, which does not lie beside it; put it there, or name it on the "
            f"command line: --methods or --estimators {name}."
        )
    return f"{path}:{function}"


def limit_from_text(text: str) -> Limit:
    """A limit as the command line takes it."""
    pairs = [part.partition("=") for part in text.split(",")]
    entry = {key: value for key, _, value in pairs}
    check_names(
        list(entry), ("replicates", "plant", "method", "estimator", "noise_variance"), "key of --limit"
    )
    try:
        replicates, noise = int(entry.get("replicates", "")), float(entry.get("noise_variance", 0))
        Limit(replicates, noise_variance=noise)
    except (ValueError, InputError):
        raise InputError(
            f"--limit {text}: give replicates=R with a whole number R of at least 0, and a positive, finite noise_variance."
        ) from None
    return Limit(**entry | {"replicates": replicates, "noise_variance": noise})  # type: ignore[arg-type]
