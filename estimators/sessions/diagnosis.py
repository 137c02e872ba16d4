"""The diagnosis that a session's records allow: of the model it was given, or of the linear models of its rig."""

from dataclasses import dataclass
from typing import Any

from estimators.sessions.missing import ModelError, what_is_missing
from estimators.sessions.proposals import Proposal, joined, propose
from estimators.sessions.session import Sequential
from oed.errors import InputError


@dataclass(frozen=True, eq=False)
class SessionDiagnosis:
    """What is missing, by whichever way the session's records allow. `of_model` corrections of the model that
    the session was given; `of_rig` the `Diagnosis` of what any linear model of the rig lacks, None where it
    was not made; `proposal` the experiment that would decide between the likeliest causes."""

    of_model: ModelError | None = None
    of_rig: Any = None
    proposal: Proposal | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        found: dict[str, Any] = {}
        if self.of_model is not None:
            best = self.of_model.cause
            found = {
                "cause": best.name, "sentence": best.sentence, "error_before": best.before, "error_after": best.after,
                "parameters": best.parameters, "ranked": [c.name for c in self.of_model.causes],
                "frequency": self.of_model.frequency, "share": self.of_model.share.tolist(),
            }  # fmt: skip
        if self.of_rig is not None:
            full = self.of_rig.to_dict()
            kept = ("effect", "detected", "p_value", "rmse_before", "rmse_after", "noise_floor", "evidence")
            found |= {k: full[k] for k in kept}
            found["ranked_effects"] = full["ranked"]
        if self.proposal is not None:
            found["next"] = {
                "between": list(self.proposal.causes), "power": self.proposal.power, "white": self.proposal.white,
            }  # fmt: skip
        return found

    def __str__(self) -> str:
        lines = []
        if self.of_model is not None:
            best = self.of_model.cause
            lines.append(f"missing from the model: {best}")
            lines.append("ranked: " + ", ".join(c.name for c in self.of_model.causes))
        if self.of_rig is not None:
            lines.append(str(self.of_rig))
        if self.proposal is not None and self.proposal.causes:
            a, b = self.proposal.causes
            lines.append(
                f"the next experiment decides between {a} and {b} with probability {self.proposal.power:.3f} "
                f"(white noise {self.proposal.white:.3f})"
            )
        return "\n".join(lines)


def diagnosis_of(session: Sequential) -> SessionDiagnosis:
    """What is missing from the session's model, or from a linear model of its rig."""
    s = session.settings
    records = session.trace.records
    if len(records) < 2:
        raise InputError(f"{len(records)} experiments are recorded; a diagnosis needs two.")
    if session.model is not None:
        worst = session.estimate().frequency
        found = what_is_missing(session.trace, session.model, worst, periodic=s.periodic, centred=s.centre)
        return SessionDiagnosis(of_model=found)
    if s.method != "diagnose-next":
        raise InputError(
            "the session has no model whose error could be diagnosed; start one with --model, or with the method "
            "diagnose-next."
        )
    import numpy as np

    from estimators.diagnosis.loop import Setting, diagnose
    from estimators.sessions.methods import nominal_power

    found = diagnose(joined(records[:-1]), records[-1], Setting(separate=True))
    power = nominal_power(s)
    amplitude = s.amplitude[0] if s.amplitude else 3 * float(np.sqrt(power))
    ahead = propose(records, s.samples, power, amplitude, np.random.default_rng([s.seed, len(records)]))
    return SessionDiagnosis(of_rig=found, proposal=ahead)
