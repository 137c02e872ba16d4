"""Every threshold of the diagnosis's claims, by name and with its reason."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Policy"]


@dataclass(frozen=True)
class Policy:
    """Thresholds of the ladder and the verdict; the field's comment says why it has its value."""

    pieces: int = 20
    # stretches over which paired errors are averaged: enough for a standard error good to a sixth, each long enough
    # for its neighbours to be nearly independent
    claim_errors: float = 1.0
    # standard errors by which unused blocks must get better: the one-standard-error rule; significance in the joint
    # fit is asked for besides, so that this need not carry the false-alarm rate alone
    least_gain: float = 0.01
    # share of the error on unused blocks below which an effect is no cause: a real plant is never exactly linear
    sane_reach: float = 8.0
    # largest simulated value, in spans of the training output, that is no explosion
    warn_constant: float = 1.0
    # a free run with more than this times the error of the record's own mean is never given without a warning
    outside: float = 0.01
    # share of test samples beyond the training range from which on it is said: below it are noise's own extremes
    removable: float = 0.02
    # (before - floor)/floor below which there is hardly anything to remove, and no share of it is given
