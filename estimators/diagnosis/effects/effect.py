"""What an effect is: one frozen object that holds all that the diagnosis knows of it.

Adding an effect is one such object in the file of its slot, or in a script: `diagnose(..., effects=[*CATALOGUE, mine])`.
Maps and forces are written in NumPy functions that act element by element, so that the same text is compiled for
the recursions, drawn as a curve, and evaluated with CasADi symbols for the export of a model.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError

Array = NDArray[Any]
TYPICAL = (0.03, 0.1, 0.3)  # rates per sample of most rigs: a model without the effect may show none
OPERATING = 0.5  # mean of an input in standard deviations, beyond which it stands on an operating level
Grid = tuple[list[list[float]], list[float]]  # parameters to start from, and the size of each


def numbered(names: Mapping[str, str], count: int) -> list[tuple[str, str]]:
    """Names and units of parameters that come several times over."""
    return [(f"{name}{i + 1}", unit) for i in range(count) for name, unit in names.items()]


class Nature(StrEnum):
    """The kind of a cause, which can be known where the cause itself is in doubt."""

    INPUT_STATIC = "static input nonlinearity"
    OUTPUT_STATIC = "static output nonlinearity"
    DYNAMIC = "dynamic nonlinearity"
    LINEAR = "linear dynamics"
    TIME = "time variation"
    ADDED = "disturbance"
    NOISE = "noise"
    SAMPLING = "sampling"


class Slot(StrEnum):
    """Where in a model an effect acts."""

    INPUT = "input"  # on what enters the linear part
    PLANT = "plant"  # inside the plant's recursion
    PATH = "path"  # beside the plant, from an input to the output
    FORM = "form"  # it changes the linear part itself: its order, its delay, its layout
    OUTPUT = "output"  # on what leaves the linear part
    ADDED = "added"  # a signal of its own on top of the output
    START = "start"  # the state at the first sample
    NOISE = "noise"  # seen in the residual, not simulated


@dataclass(frozen=True, eq=False)
class Clock:
    """The common clock of two experiments, in samples since the first training sample.

    Attributes
    ----------
    k : ndarray
        (N,) sample numbers on the common clock.
    length : int
        Samples of the training record: ramps are per training record.
    lead : int
        Samples of constant input that were put before the record: what adds up, adds up from the record on.
    """

    k: Array
    length: int
    lead: int = 0

    @property
    def turn(self) -> Array:
        """Time in training records, (N,)."""
        return self.k / self.length


@dataclass(frozen=True, eq=False)
class Sizes:
    """Signals of the model that an effect is added to, from which its starts take their sizes.

    Attributes
    ----------
    u, y : ndarray
        (N,) the effect's input, and the simulated output.
    clock : Clock
        Time of the samples.
    position, velocity : ndarray
        (N,) of the linear part of a plant, in units of the input.
    poles : ndarray
        Of the linear part, in the z-plane.
    damping : float
        Of a plant, in units of its stiffness: sample.
    """

    u: Array
    y: Array
    clock: Clock
    position: Array = field(default_factory=lambda: np.zeros(1))
    velocity: Array = field(default_factory=lambda: np.zeros(1))
    poles: Array = field(default_factory=lambda: np.zeros(0))
    damping: float = 1.0

    @cached_property
    def rates(self) -> list[float]:
        """Rates per sample that a process may have: of the model's real poles, and a few more over their range."""
        known = [-np.log(z.real) for z in self.poles if abs(z.imag) < 1e-9 and 0.05 < z.real < 0.9995]
        slow = -np.log(min(max((abs(z) for z in self.poles), default=0.9), 0.999))
        return sorted({round(float(r), 6) for r in (*known, slow, *TYPICAL)})

    @cached_property
    def level(self) -> float:
        """Mean of the input, not quite zero."""
        return abs(float(np.mean(self.u))) + 1e-3 * self.su

    @cached_property
    def su(self) -> float:
        """Standard deviation of the input."""
        return float(np.std(self.u)) + 1e-300

    @cached_property
    def sy(self) -> float:
        """Standard deviation of the simulated output."""
        return float(np.std(self.y)) + 1e-300

    @cached_property
    def sx(self) -> float:
        """Standard deviation of the position, not quite zero."""
        return float(np.std(self.position)) + 1e-12 * self.su

    @cached_property
    def sv(self) -> float:
        """Standard deviation of the velocity, not quite zero."""
        return float(np.std(self.velocity)) + 1e-12 * self.su

    def centres(self, x: Array) -> list[float]:
        """The lower, middle and upper level of a signal.

        Parameters
        ----------
        x : ndarray
            (N,) the signal.

        Returns
        -------
        list of float
            Its 15 %, 50 % and 85 % quantiles.
        """
        return [float(v) for v in np.quantile(x, (0.15, 0.5, 0.85))]

    def times(self, count: int = 40) -> Array:
        """Times spread over the record, its ends left out.

        Parameters
        ----------
        count : int
            How many.

        Returns
        -------
        ndarray
            (count,) in samples of the clock.
        """
        return self.clock.k[0] + np.linspace(0.03, 0.97, count) * len(self.u)


def level_before(u: Array) -> float:
    """The input before a record began: its first value where the signal stands on a level, zero where it swings about zero."""
    mean, power = np.add.reduce(u) / len(u), np.dot(u, u) / len(u)
    return float(u[0]) if mean * mean > OPERATING**2 * (power - mean * mean) else 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Effect:
    """One effect that a linear model can lack.

    Attributes
    ----------
    key : str
        Name of the variant, unique among the effects of a diagnosis.
    cause : str
        The cause, a word of the vocabulary of `oed diagnose`; variants of one cause share it.
    nature : Nature
        The kind of cause.
    slot : Slot
        Where it acts.
    sentence : str
        What it does, for the report.
    parameters : mapping of str to str
        Unit of each parameter by its name: u, y, 1, sample, and products of these.
    trials : float
        Its price: about how many independent shapes a search over its shape parameters tries; the significance of its
        likelihood ratio is corrected by it. Times the record's length where `per_sample`.
    per_sample : bool
        Whether `trials` is a fraction of the number of samples, as for a time or a frequency.
    apply : callable, optional
        (signal, parameters, clock) -> signal, at the input, the output, or added to it; infinite where they are not admissible.
    force : callable, optional
        (p, v, u, q, s, c) -> force inside the plant, in input units, taken from the input: position, velocity, input, the plant's
        last state, a modulating signal, parameters. NumPy functions of numbers, as it is compiled.
    inside : callable, optional
        parameters -> fields of `plant_kernels.Elements`: dry friction, hysteresis and stops, which a force cannot express.
    signal : callable, optional
        (inputs (N, nu), channel, parameters, clock) -> (N,) s of `force`, what a path adds, what becomes of an input or (last) the output.
    change : mapping, optional
        By layout, how the logarithms of its rates move per unit of the first parameter, at the time of the second.
    layouts : frozenset of str, optional
        Layouts of the plant that allow it; all where it is not given.
    starts : callable, optional
        Sizes -> Grid to be scanned by score.
    amplitude : int, optional
        The parameter in which the output is nearly linear: its size is read off the score.
    more : callable, optional
        (channel, fit, input) -> a further start, or None.
    search : callable, optional
        (channel, fit, inputs not in the model) -> fits, where starts are no grid of shapes.
    each, joint : bool
        Whether it reads one input by itself inside the plant: it is tried with each of several, else all act as one; whether its
        signal is (N, nu), what becomes of every input as the parts before it have left it.
    alone : bool
        Whether it is looked for in a linear model only, as it replaces its dynamics.
    lagged : bool
        Whether an actuator's lag may stand before it: the candidate is then also fitted with one.
    block : bool
        Found only as a block structure, once simple effects leave a coloured residual.
    shape : callable, optional
        (size, order) -> names and units, where the number of parameters depends on the part's size or the model's order.
    refines : tuple of str
        Simpler effects that it resembles: it is tried only where one of them did well, in that layout.
    extends : str
        A simpler effect whose parameters come first in its own: also started from where that ended.
    family : str
        Siblings share it: they are put up against one another with all other effects in the model.
    curve : callable, optional
        (x, parameters) -> the characteristic that is drawn; a static map's and a force's are known without.
    against : {"", "position", "velocity"}
        What the curve of a plant's effect is drawn over; empty where it has none.
    memory, linear : bool
        Whether an effect at the output is more than a static curve, and whether it is linear in what it is given.
    slopes : callable, optional
        (parameters, clock) -> (parameter, (N,) derivative) of an added signal, by those parameters that it is linear in.
    between, ahead : bool
        Whether at the output it follows the signal between the samples, or reads it later than the clock says, beyond a record's end.
    settles, reversing : bool
        Whether it began before a later experiment, and has settled there; whether it acts where a motion turns: misfits there are no outliers.
    two_sided : bool
        Whether the record must reach +-limit for both sides to be known.

    Raises
    ------
    InputError
        If it lacks what its slot needs.
    """

    key: str
    cause: str
    nature: Nature
    slot: Slot
    sentence: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    trials: float = 1.0
    per_sample: bool = False
    apply: Callable[[Any, Array, Clock], Any] | None = None
    force: Callable[..., Any] | None = None
    inside: Callable[[Array], dict[str, float]] | None = None
    signal: Callable[[Array, int, Array, Clock], Array] | None = None
    change: Mapping[str, tuple[float, ...]] | None = None
    layouts: frozenset[str] | None = None
    starts: Callable[[Sizes], Grid] | None = None
    amplitude: int | None = None
    more: Callable[[Any, Any, int], Any] | None = None
    search: Callable[[Any, Any, tuple[int, ...]], Iterator[Any]] | None = None
    each: bool = False
    joint: bool = False
    alone: bool = False
    lagged: bool = False
    block: bool = False
    shape: Callable[[int, int], list[tuple[str, str]]] | None = None
    refines: tuple[str, ...] = ()
    extends: str = ""
    family: str = ""
    curve: Callable[[Array, Array], Array] | None = None
    against: str = ""
    memory: bool = False
    linear: bool = False
    slopes: Callable[[Array, Clock], Iterable[tuple[int, Array]]] | None = None
    between: bool = False
    ahead: bool = False
    settles: bool = False
    reversing: bool = False
    two_sided: bool = False

    def __post_init__(self) -> None:
        lacks = [words for missing, words in _needs(self) if missing]
        if lacks:
            raise InputError(
                f"the effect {self.key!r} in slot {str(self.slot)!r} lacks {' and '.join(lacks)}: give it."
            )

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each parameter."""
        return tuple(self.parameters.values())

    @cached_property
    def timed(self) -> bool:
        """Whether its last parameter is the time at which something changes."""
        return self.per_sample and self.units[-1:] == ("sample",)

    @property
    def static(self) -> bool:
        """Whether it is a curve of one signal."""
        return self.nature in (Nature.INPUT_STATIC, Nature.OUTPUT_STATIC)

    @property
    def simulated(self) -> bool:
        """Whether it is part of the simulated output, and so tried on every record."""
        return self.slot is not Slot.NOISE

    def tries(self, n: int) -> float:
        """Independent shapes that the search tries on a record.

        Parameters
        ----------
        n : int
            Samples of the record.

        Returns
        -------
        float
            At least 1.
        """
        return max(1.0, self.trials * (n if self.per_sample else 1.0))

    def fits(self, layout: str) -> bool:
        """Whether it can sit in a layout: changes need a rate that they change, moving parts a velocity.

        Parameters
        ----------
        layout : str
            Layout of the plant.

        Returns
        -------
        bool
            False where it makes no sense.
        """
        if self.layouts is not None:
            return layout in self.layouts
        return self.change is None or layout in self.change

    def drawn(self, x: Array, q: Array) -> Array | None:
        """Its characteristic.

        Parameters
        ----------
        x : ndarray
            (M,) where it is drawn.
        q : ndarray
            Its parameters.

        Returns
        -------
        ndarray or None
            (M,) values; None where it is no curve.
        """
        if self.curve is not None:
            return self.curve(x, q)
        if self.force is not None and self.against:
            still = np.zeros_like(x)
            at = (x, still) if self.against == "position" else (still, x)
            value = self.force(*at, still, still, still, q)
            return x + value if self.against == "position" else value
        static = self.apply if self.static else None
        return None if static is None else static(x, q, Clock(np.zeros_like(x), 1))


def _needs(e: Effect) -> list[tuple[bool, str]]:
    """(whether it is missing, in words) for everything that the slot of an effect needs."""
    on_signal = e.slot in (Slot.INPUT, Slot.OUTPUT, Slot.ADDED)
    found = e.starts is not None or e.search is not None or e.block
    acts = e.force is not None or e.inside is not None or e.change is not None
    amplitude = e.amplitude is not None and e.amplitude >= len(e.parameters)
    modulates = e.signal is not None and e.force is None and not (on_signal or e.slot is Slot.PATH)
    return [
        (not e.key or not e.cause or not e.sentence, "a key, a cause and a sentence"),
        (on_signal and e.apply is None, "apply, what it makes of its signal"),
        (e.slot is Slot.PLANT and not acts, "a force, elements inside the plant, or a change of its rates"),
        (e.simulated and not found, "starts, a search of its own, or to be a block"),
        (
            e.starts is not None and not e.parameters and e.shape is None,
            "the names and units of its parameters",
        ),
        (amplitude, "a parameter that is its linear amplitude"),
        (e.slot is Slot.PATH and e.shape is None, "shape, its parameters by its size"),
        (e.trials <= 0, "a positive price"),
        (modulates, "the force that its signal modulates"),
    ]
