"""What the user knows and wants of a diagnosis, and the thresholds of claims and of the ladder, each with its reason."""

from dataclasses import dataclass, field
from enum import Enum

from estimators.diagnosis.effects import CATALOGUE, Effect
from oed.errors import InputError


class Effort(Enum):
    """How much work a diagnosis may be: the stages that run, and how many candidates each of them fits."""

    QUICK = "quick"
    NORMAL = "normal"
    THOROUGH = "thorough"


@dataclass(frozen=True)
class Policy:
    """Thresholds of the ladder and the verdict; the comment beneath a field says why it has its value."""

    pieces: int = 20
    # stretches over which paired errors are averaged: enough for a standard error good to a sixth, each long enough
    # for its neighbours to be nearly independent
    claimed: tuple[float, float] = (1.0, 0.01)
    # by how many standard errors, and by what share of the error, unused blocks must get better for a named effect: the
    # one-standard-error rule, as significance in the joint fit carries the false-alarm rate; a real plant is never
    # exactly linear, so that the smallest gains are no causes
    searched: tuple[float, float] = (2.0, 0.05)
    # the same for models whose terms or shape were searched for on the same blocks: the best of hundreds is lucky there
    overwhelming: tuple[float, float] = (2.0, 0.5)
    # a gain on unused blocks that needs no likelihood ratio beside it: parameters that the record hardly determines cost
    # unused blocks much and the record itself nothing; luck does not halve the error of every block
    unchecked: tuple[float, float] = (4.0, 0.5)
    # a gain over any other answer that no second search for the terms must confirm: hundreds of candidates may find a tenth
    # of an error by luck, not a half
    carried: tuple[float, float] = (0.9, 1.5)
    # share of what the answer explains that named effects must explain to lend their names to it, and by what factor
    # their error may be above its: of a large error nine tenths go with any curve that is nearly right
    agreed: float = 0.5
    # the share where a term of the discovered equation is of their nature: the two searches then found one thing twice, and
    # the names stand for more of it than all else together
    lasting: float = 1 / 3
    # share of the error on unused blocks that a model must take away for something to be missing though the test record does
    # not bear it: luck finds a tenth, a disturbance that came once a sixth
    sane_reach: tuple[float, float] = (8.0, 3.0)
    # largest distance of a simulated output from the training output's middle that is no explosion: in half spans of it,
    # and in those of the linear model's run where that leaves the training output too
    constant: float = 1.0
    # a free run with more than this times the error of the record's own mean is never given without a warning
    outside: float = 0.01
    # share of test samples beyond the training range from which on it is said: below it are noise's own extremes
    dark: float = 0.01
    # power of the training input, of the test input's at the same frequency, below which that frequency is not covered
    removable: float = 0.02
    # (before - floor)/floor below which there is hardly anything to remove, and no share of it is given


@dataclass(frozen=True, eq=False)
class Setting:
    """What the user knows and wants.

    `orders` order stated per output: what the data ask for beyond it (a delay, an order, a mode) is named;
    empty: none is stated; `structure` "diagonal" where each output has its own input; `deviations` true: signals are deviations
    from the operating point, where every record starts at rest: training records that do not are named so.
    False: as logged. None: the data decide; `skip` test samples that may set the initial state and are left
    out of the error; `alpha` false-alarm rate over all tests together; `separate` whether the two records are
    on separate clocks; `effort` how much work it may be; `policy` thresholds of the claims; `effects` what is
    looked for: the catalogue, and effects of one's own.
    """

    orders: tuple[int, ...] = ()
    structure: str = "full"
    deviations: bool | None = None
    skip: int = 0
    alpha: float = 0.01
    separate: bool = False
    effort: Effort = Effort.NORMAL
    policy: Policy = field(default_factory=Policy)
    effects: tuple[Effect, ...] = CATALOGUE

    def __post_init__(self) -> None:
        for effect in self.effects:
            if not isinstance(effect, Effect):
                raise InputError(
                    f"an effect is given as {effect!r}; give objects, as in effects=[*CATALOGUE, mine] (estimators.diagnosis.effects)."
                )
