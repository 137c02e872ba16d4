"""What the theory predicts for the power iterations: limit spectra, bias, efficiency, and where the claim fails."""

from oed.theory.cases import ClaimCase, claim_cases, claim_map
from oed.theory.claim import ClaimRow, gain_scaling_residual, map_of_claim, peak_sinusoid_spectrum
from oed.theory.limit import LimitSpectrum, limit_spectrum
from oed.theory.limit_on_grid import limit_spectrum_on_grid, spectra_of_iterations

__all__ = [
    "ClaimCase", "ClaimRow", "LimitSpectrum", "claim_cases", "claim_map", "gain_scaling_residual", "limit_spectrum",
    "limit_spectrum_on_grid", "map_of_claim", "peak_sinusoid_spectrum", "spectra_of_iterations",
]  # fmt: skip
