"""Linear dynamics that the model lacks: paths beside the plant, more poles, longer delays, a state at the start."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from estimators.diagnosis.effects.effect import Effect, Nature, Slot, numbered

__all__ = ["INITIAL", "PATH"]


def _rational(size: int, order: int) -> list[tuple[str, str]]:
    return numbered({"b": "y/u"}, size) + numbered({"f": "1"}, size)


def _paths(channel: Any, base: Any, effect: Effect, j: int, sizes: tuple[int, ...]) -> Iterator[Any]:
    """A path from an input, started from a linear fit to the residual."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part, Structure

    residual = replace(channel, y=base.residual, step=0.0)
    for size in sizes:
        f = fit_linear(residual, Structure(size, (j,)))
        p = np.concatenate((base.p, f.p[size:], f.p[:size]))
        scales = np.concatenate((base.scales, f.scales[size:], f.scales[:size]))
        yield fit(channel, base.structure.adding(Part(effect, j, size)), p, scales, noise=base.noise)


def _modes(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    if base.structure.effects:  # a linear model takes more poles instead
        yield from _paths(channel, base, MODE, base.structure.inputs[0], (2,))


def _crossings(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    for j in others:
        yield from _paths(channel, base, CROSS, j, (1, 2))


def _delayed_orders(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or s.effects or s.delay:
        return
    for order, delay in ((s.order + 1, 2), (s.order + 1, 3), (s.order + 2, 2), (s.order + 2, 3)):
        if order - delay >= 1:
            new = replace(s, order=order, taps=order - delay, delay=delay)
            f = fit_linear(channel, new, noise=base.noise)
            yield replace(f, structure=f.structure.adding(Part(DELAY_ORDER)))


def _wider(channel: Any, base: Any, effect: Effect, extra: int) -> Iterator[Any]:
    """More poles; beside effects that act on the input, from a linear fit to what they make of it."""
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear
    from estimators.diagnosis.model.simulation import acted
    from estimators.diagnosis.model.structure import Part

    s, part = base.structure, Part(effect, 0, extra)
    if s.layout != "tf" or any(q.effect.slot is not Slot.INPUT for q in s.effects):
        return
    wide = replace(s, order=s.order + extra, taps=s.taps + extra, parts=s.parts[: s.base])
    if not s.effects:
        f = fit_linear(channel, wide, noise=base.noise)
        yield replace(f, structure=f.structure.adding(part))
        return
    entering = acted(s, base.p, channel.u, channel.clock)
    if entering is None:
        return
    f = fit_linear(replace(channel, u=entering), replace(wide, inputs=tuple(range(len(s.inputs)))))
    start = s.slices()[s.base].start
    p, scales = np.concatenate((f.p, base.p[start:])), np.concatenate((f.scales, base.scales[start:]))
    yield fit(channel, replace(wide, parts=(*s.parts, part)), p, scales, noise=base.noise)


def _initial_states(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.simulation import free_responses
    from estimators.diagnosis.model.structure import Part

    X = free_responses(base.structure, base.p, len(channel))
    theta = np.linalg.lstsq(X[channel.keep], base.residual[channel.keep], rcond=None)[0]
    scales = np.concatenate((base.scales, np.abs(theta) + 0.1 * np.abs(theta).max() + 1e-300))
    yield fit(
        channel,
        base.structure.adding(Part(INITIAL)),
        np.concatenate((base.p, theta)),
        scales,
        noise=base.noise,
    )


def _linear(key: str, cause: str, slot: Slot, trials: float, sentence: str, **fields: Any) -> Effect:
    return Effect(
        key=key, cause=cause, nature=Nature.LINEAR, slot=slot, trials=trials, sentence=sentence, **fields
    )


MODE = _linear("mode", "missing_mode", Slot.PATH, 20, "a second-order mode in parallel with the model",
               shape=_rational, search=_modes)  # fmt: skip
CROSS = _linear("cross", "mimo_cross", Slot.PATH, 5, "another input acts on this output",
                shape=_rational, search=_crossings)  # fmt: skip
DELAY_ORDER = _linear("delay_order", "transport_delay", Slot.FORM, 3,
                      "the input acts at least two samples later than modelled, through one order more",
                      search=_delayed_orders)  # fmt: skip
ORDER_ONE = _linear("order_one", "sensor_lag", Slot.FORM, 3, "the linear part needs one more order",
                    search=lambda channel, base, others: _wider(channel, base, ORDER_ONE, 1))  # fmt: skip
ORDER = _linear("order", "missing_mode", Slot.FORM, 3, "the linear part needs a higher order",
                search=lambda channel, base, others: _wider(channel, base, ORDER, 2))  # fmt: skip
INITIAL = _linear("initial", "initial_condition", Slot.START, 1, "the record does not start at rest",
                  shape=lambda size, order: numbered({"x": "y"}, order), search=_initial_states)  # fmt: skip
OUTFLOW = Effect(
    key="outflow", cause="square_root_outflow", nature=Nature.DYNAMIC, slot=Slot.FORM, trials=30, block=True,
    sentence="the outflow grows with the square root of the level, and the upper tank overflows",
)  # fmt: skip

PATH = (MODE, CROSS, DELAY_ORDER, ORDER_ONE, ORDER, INITIAL, OUTFLOW)
