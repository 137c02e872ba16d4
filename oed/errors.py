"""The exceptions of the suite, and the outcomes that are data rather than exceptions.

At the border (user input, a rig, a solver that broke) the suite raises; inside loops a failure is a
`Status` beside the number, so that a campaign of thousands of runs records it and goes on."""

import difflib
from collections.abc import Iterable, Sequence
from enum import Enum
from math import inf
from numbers import Real


class OedError(Exception):
    """Base of every exception that the suite raises on purpose."""


class InputError(OedError, ValueError):
    """An argument, file or option breaks a rule; the message gives the value, the rule and the remedy."""


class ExperimentError(OedError, RuntimeError):
    """The system under test returned something that is not a measurement of the right shape."""


class NotIdentifiable(OedError, ValueError):
    """The data or the input carry no information on some combination of parameters, which is named."""


class InfeasibleDesign(OedError, ValueError):
    """No input satisfies all constraints; the message names those that clash."""


class SolverFailure(OedError, RuntimeError):
    """An optimiser stopped without a point whose own certificate could be trusted."""


class CampaignError(OedError, RuntimeError):
    """A folder of results cannot be used as asked: other settings, another version, or damage."""


class Status(Enum):
    """How a computation ended; the value is the sentence that a user reads."""

    OK = "The result is complete."
    CONVERGED = "The change of the estimate fell below its own standard error."
    BUDGET = "The budget of experiments was used up."
    NEGATIVE_SQUARE = (
        "The squared gain estimate is negative: the noise outweighs the signal in this pair of experiments, "
        "so no gain is reported for it."
    )
    NOT_FINITE = "The result is not finite."
    MAX_ITERATIONS = "The iteration limit was reached before the optimality residual met its tolerance."
    INACCURATE = "The result is usable, but its certificate is wider than the tolerance asked for."
    COMPETING = (
        "Another peak is as high within two standard errors: the number and its interval hold for the peak at "
        "this frequency, which need not be the highest; take more iterations or longer experiments."
    )
    UNSTABLE = "The estimated model is unstable."
    SINGULAR = "The information matrix is singular: some combination of parameters is not determined."
    TIME_LIMIT = "The time limit was reached."
    FAILED = "The computation failed."

    @property
    def ok(self) -> bool:
        """Whether the numbers beside this status can be used as they stand."""
        return self in (Status.OK, Status.CONVERGED, Status.BUDGET)


def check_names(names: Iterable[str], known: Sequence[str], what: str) -> None:
    """Raise an InputError that lists what exists, if one of the names does not."""
    for name in names:
        if name not in known:
            raise InputError(
                f"there is no {what} named {name!r}{near(name, known)}; choose from {', '.join(known)}."
            )


def check_sampling_time(dt: object, most: float = 1.0) -> None:
    """Raise an InputError unless it is a positive number of seconds, of which `most` are a finite time."""
    if not (isinstance(dt, Real) and not isinstance(dt, bool) and 0 < float(dt) * most < inf):
        said = (
            f"the text {dt!r}; it must be a number of seconds, without quotes"
            if isinstance(dt, str)
            else f"{dt}; it must be a positive number of seconds"
        )
        raise InputError(f"the sampling time is {said}.")


LARGEST_EXPONENT = 150
"""Of a power of ten whose square is a double, with room for the sums of many: variances are squares, in the user's units."""


CUBES = 3
"""Power of signals that is reported in their own units wherever more than a linear model may be: the coefficient of a cubic force,
whose variance is a sixth power, and the fourth powers of gains. Other units inside would not help: the answer is in the user's."""


def largest(power: int = 1) -> float:
    """The largest size of which the square of the `power`-th power is a double; one over it is the smallest."""
    return 10.0 ** (LARGEST_EXPONENT // power)


def check_size(what: str, size: float, power: int = 1) -> None:
    """Raise an InputError unless the square of a size's `power`-th power is a double; nothing at all has no size."""
    most = largest(power)
    if size and not 1 / most <= size <= most:
        raise InputError(
            f"{what} is {size:.3g}; it must lie between {1 / most:g} and {most:g}, so that the variances of what is made of it "
            "are numbers: choose other units."
        )


def interruption(error: BaseException | None) -> KeyboardInterrupt | None:
    """The interruption behind an error: one that reaches compiled code comes out of it as a SystemError of the interpreter's."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error


def near(name: str, known: Iterable[str]) -> str:
    """ " (did you mean this?)", where one of the names is much like the one that is not among them."""
    lower = {one.lower(): one for one in known}
    close = difflib.get_close_matches(name.lower(), lower, 1)
    return f" (did you mean {lower[close[0]]}?)" if close else ""
