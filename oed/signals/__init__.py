"""Signals: from spectra to samples, the sinusoids of a spectrum, and noise that is a pure function of its place."""
