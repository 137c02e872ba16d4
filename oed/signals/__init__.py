"""Signals: from spectra to samples, the sinusoids of a spectrum, and noise that is a pure function of its place."""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from oed.signals.synthesis import binary, crest_factor, filtered_noise, multisine, realise

__all__ = ["binary", "crest_factor", "filtered_noise", "multisine", "realise"]

__getattr__, __dir__ = exporting(__name__)
