"""The verdict on all outputs together: causes ranked, evidence in sentences, what cannot be told apart, what remains."""

from __future__ import annotations

from typing import Any

import numpy as np

from estimators.diagnosis.effects import Effect, Nature, Slot
from estimators.diagnosis.examination import Examined, Setting
from estimators.diagnosis.model.fitting import Fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.record.leftover import Leftover, leftovers
from estimators.diagnosis.record.paired import as_good
from estimators.diagnosis.search.selection import causes_of

__all__ = ["verdict"]

UNKNOWN = "unknown"


def _unexplained(out: Examined, rest: list[Leftover], alpha: float) -> Leftover | None:
    """What is left, where it weighs more than all that was found: then the cause is in no catalogue."""
    a = out.attribution
    found = [key for key in a.chosen if key != "coloured"]
    if out.signatures:
        return None
    explained = 0.0
    if found:  # in one-step errors, or in simulation errors: a noise model predicts part of any model error
        before = float(np.mean(a.base.residual[out.channel.keep] ** 2))
        after = float(np.mean(a.final.residual[out.last.keep] ** 2))
        simulated = a.final.n * float(np.log(before / max(after, 1e-300)))
        explained = max(a.coloured.criterion - a.final.criterion, simulated, 0.0)
    limit = (
        alpha / 10 if not a.chosen else 1e-6
    )  # significance under a noise model or a wrong effect is less sure
    for item in rest:
        noisy = item.nature == Nature.NOISE
        if item.p_value >= (1e-6 if noisy else limit):
            continue
        if noisy and all(a.p_values.get(key, 1.0) > alpha / 100 for key in found):
            return item
        if not noisy and item.gain > max(0.5 * explained, 6.0):
            return item
    return None


def verdict(outputs: list[Examined], setting: Setting) -> dict[str, Any]:
    """Causes of all outputs together.

    Parameters
    ----------
    outputs : list of Examined
        What was found for each output.
    setting : Setting
        What is known; its false-alarm rate is shared by the outputs.

    Returns
    -------
    dict
        The fields of a `Diagnosis` that name causes.
    """
    known = {e.key: e for e in setting.effects}
    evidence: list[str] = []
    order: list[tuple[float, str]] = []
    p_value = 1.0
    parameters: dict[str, tuple[float, float, str]] = {}
    pool: dict[str, float] = {}
    alpha = setting.alpha / len(outputs)
    natures: list[str] = []
    remaining: list[str] = []
    inadequate: list[bool] = []
    for i, out in enumerate(outputs):
        a = out.attribution
        tag = f" on output {i + 1}" if len(outputs) > 1 else ""
        for sig in out.signatures:
            weight = 1e6
            if (
                sig.key == "outliers"
            ):  # by what they add to the residual: peaks of a misfit are few beside their cause
                rest = float(np.sum(a.final.residual[out.last.keep] ** 2)) + 1e-300
                weight = 1e3 + a.final.n * float(np.log1p(sig.count * sig.size**2 / rest))
            order.append((weight, sig.key))
            evidence.append(sig.sentence)
            p_value = 0.0
        follows = a.feedback < alpha / 100
        if follows:
            order.append((5e5, "feedback"))
            p_value = min(p_value, a.feedback)
            evidence.append(
                f"past innovations help to predict the input{tag} (p = {a.feedback:.2g}): the data are from a closed loop"
            )
        by_key = {c.key: c for c in a.claims}
        above = np.inf
        for rank, key in enumerate(a.chosen):
            gain = by_key[key].gain if key in by_key else 100.0
            if rank == 0:
                weight = 1e3 + gain
            else:  # never above what comes before it in the attribution's own order
                weight = min(gain * 1e-3 if follows and key != "coloured" else max(gain, 1.0), 0.999 * above)
            above = weight
            order.append((weight, key))
            p = a.p_values.get(key, by_key[key].p_value if key in by_key else 0.0)
            p_value = min(p_value, p)
            weak = ""
            if key in a.refinements:  # below every cause
                order[-1] = (min(weight, 10.0), key)
                weak = (f"; it explains {100 * a.refinements[key]:.2g} % of what {known[a.chosen[0]].cause} does, "
                        "and may only refine the shape of that")  # fmt: skip
            evidence.append(f"{known[key].sentence}{tag}: corrected p = {p:.2g}{weak}{_assumed(out, key)}")
        rest = leftovers(out.last, a.final, alpha=alpha / 10)
        remaining += [item.sentence + tag for item in rest[:3]]
        inadequate.append(any("nonlinearity" in item.nature and item.p_value < 1e-6 for item in rest))
        strange = _unexplained(out, rest, alpha)
        if strange is not None:
            natures.append(strange.nature)
            p_value = min(p_value, strange.p_value)
            order.append((1e7, strange.key or UNKNOWN))
            words = "what is left" if strange.key else "no effect of the catalogue explains what is left"
            evidence.insert(0, f"{words}{tag}: {strange.sentence}")
        elif setting.deviations and not len(a.final.noise) and not out.signatures:
            for item in rest:
                if item.key and item.p_value < 1e-6:
                    order.append((50.0, item.key))
                    evidence.append(f"what is left{tag}: {item.sentence}")
        for key, others in a.rivals.items():
            evidence.append(f"instead of {known[key].cause}{tag} it may as well be {' or '.join(others)}")
        for c in a.claims:
            pool[c.cause] = pool.get(c.cause, 0.0) + max(c.gain, 0.0)
        parameters.update(_parameters(a.final, f"y{i + 1}." if len(outputs) > 1 else ""))
    order.sort(key=lambda x: -x[0])
    keys = [k for _, k in order]
    chosen = causes_of(keys, setting.effects)
    detected = bool(chosen)
    rest = [
        label for label, gain in sorted(pool.items(), key=lambda x: -x[1]) if label not in chosen and gain > 0
    ]
    ranked = chosen + rest if detected else ["none"]
    confusable = _confusable(outputs, inadequate, ranked[0], known)
    refining = causes_of([key for out in outputs for key in out.attribution.refinements], setting.effects)
    nature = "none" if not keys else natures[0] if keys[0] == UNKNOWN else known[keys[0]].nature.value
    return {
        "detected": detected, "effect": ranked[0], "variant": ", ".join(dict.fromkeys(keys)), "ranked": tuple(ranked),
        "nature": nature, "p_value": p_value, "evidence": tuple(evidence),
        "parameters": parameters, "confusable": confusable, "remaining": "; ".join(remaining),
        "refinements": tuple(refining), "floor_is_bound": bool(remaining) or any(_absorbing(out) for out in outputs),
    }  # fmt: skip


def _assumed(out: Examined, key: str) -> str:
    """What a symmetric limit takes for granted where the record reaches one side of it only."""
    f, channel = out.attribution.final, out.last
    at = next((i for i, part in enumerate(f.structure.parts) if part.key == key), None)
    if at is None or not f.structure.parts[at].effect.two_sided:
        return ""
    limit = abs(float(f.p[f.structure.slices()[at]][0]))
    if f.structure.parts[at].effect.slot is Slot.INPUT:
        x = channel.u[:, f.structure.parts[at].channel]
    else:
        x = simulate(f.structure, f.p, channel.u, channel.clock)
    beyond = [bool(np.any(side * x > 0.98 * limit)) for side in (1.0, -1.0)]
    if all(beyond) or not any(beyond):
        return ""
    return "; this record reaches one side of the limit only, the other side is assumed"


def _absorbing(out: Examined) -> bool:
    """Whether a noise model stands beside an effect: it may have taken some of the model error for noise."""
    return len(out.attribution.final.noise) > 0 and any(
        "nonlinearity" in part.effect.nature for part in out.attribution.final.structure.effects
    )


NEAR = 0.7  # of the first cause's gain


def _confusable(
    outputs: list[Examined], inadequate: list[bool], first: str, known: dict[str, Effect]
) -> tuple[str, ...]:
    """Causes that the record cannot tell from the first one: single effects as good, or as good beside others.

    Where the final residual still shows a nonlinearity, no model is right, and a difference between two wrong ones
    decides little: then every cause counts that explains by itself most of what the first one does, or that is not
    worse beyond the standard errors of the difference.
    """
    names: list[str] = []
    for out, wrong in zip(outputs, inadequate, strict=True):
        a = out.attribution
        mine = next((c for c in a.claims if c.cause == first), None)
        if mine is not None:
            alone = len(a.final.structure.effects) == 1
            others = [c for c in a.claims if c.cause != first and c.p_value < 0.01]
            names += [
                c.cause
                for c in others
                if (alone and as_good(mine.fit, c.fit, adequate=not wrong))
                or (wrong and c.gain > NEAR * mine.gain)
            ]
        for key, others_near in a.rivals.items():
            if known[key].cause == first:
                names += others_near
    return tuple(dict.fromkeys(names))


def _parameters(f: Fit, prefix: str) -> dict[str, tuple[float, float, str]]:
    """Effect parameters with standard errors from the Jacobian."""
    out: dict[str, tuple[float, float, str]] = {}
    if not f.jacobian.size:
        return out
    norms = np.sqrt(np.sum(f.jacobian**2, axis=0)) + 1e-300
    H = (f.jacobian / norms).T @ (f.jacobian / norms)
    covariance = np.linalg.pinv(H) * f.variance / np.outer(norms, norms).clip(1e-290)
    se = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    for part, sl in zip(f.structure.parts, f.structure.slices(), strict=True):
        for i, (name, unit) in enumerate(part.parameters(f.structure.order)):
            label = f"{prefix}{part.key}.{name}"
            if label in out:  # the same effect at another input
                label += f"_{part.channel + 1}"
            out[label] = (float(f.p[sl.start + i]), float(se[sl.start + i]), unit)
    return out
