"""What the theory predicts for the power iterations: limit spectra, bias, efficiency."""

from oed.theory.limit import LimitSpectrum, limit_spectrum, limit_spectrum_on_grid, spectra_of_iterations

__all__ = ["LimitSpectrum", "limit_spectrum", "limit_spectrum_on_grid", "spectra_of_iterations"]
