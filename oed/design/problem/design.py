"""What a design is: the spectrum, its loss, and the certificate that bounds every other spectrum's."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.problem.certificate import Certificate
from oed.design.problem.information_maps import InformationMap
from oed.design.problem.words import in_words
from oed.errors import Status


@dataclass(frozen=True, eq=False)
class Design:
    """An optimal input spectrum with its certificate.

    Attributes
    ----------
    spectrum : Spectrum
        One-sided lines.
    criterion : Criterion
        What it is optimal for.
    loss : float
        Loss per sample at the stated power and noise.
    bound : float
        No admissible spectrum has a smaller loss.
    certificate : Certificate
        The evidence for the bound.
    status : Status
        OK where the gap is within the tolerance that was asked for.
    information : ndarray
        (n, n) Fisher information per sample.
    map : InformationMap
        The model, reduced to what designs need.
    power_used : dict
        Budget name -> used power.
    limits : dict
        Budget name -> limit.
    solver : str
        How the weights were found.
    rounds : int
        Rounds of column generation.
    """

    spectrum: Spectrum
    criterion: Criterion
    loss: float
    bound: float
    certificate: Certificate
    status: Status
    information: NDArray[np.float64]
    map: InformationMap
    power_used: dict[str, float]
    limits: dict[str, float]
    solver: str
    rounds: int

    def __post_init__(self) -> None:
        # Loss and bound are computed apart; where rounding puts the loss below the bound, the loss bounds as well.
        if 0 < self.bound - self.loss <= 1e-6 * abs(self.loss):
            object.__setattr__(self, "bound", self.loss)

    @property
    def gap(self) -> float:
        """Relative distance (loss - bound) / bound."""
        return (self.loss - self.bound) / self.bound

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.map.names

    def efficiency(self, spectrum: Spectrum) -> float:
        """Certified bound over the loss of another spectrum: at most 1 for an admissible one.

        Parameters
        ----------
        spectrum : Spectrum
            Any spectrum with as many channels.

        Returns
        -------
        float
            Efficiency; 0 where the spectrum does not determine what is asked.
        """
        return self.bound / self.criterion.loss(self.map.of_spectrum(spectrum))

    @property
    def efficiency_white(self) -> float:
        """Efficiency of white noise, equal on all channels, at the largest power within the limits."""
        from oed.design.problem.white import white_information

        return self.bound / self.criterion.loss(
            white_information(self.map, self.limits, self.spectrum.total_power)
        )

    def plot(self) -> Any:
        """The spectrum's lines above the sensitivity that certifies them, as a matplotlib Figure.

        Returns
        -------
        matplotlib.figure.Figure
            Two panels; `savefig` writes it.
        """
        from oed.design.plots import plot_with_certificate

        return plot_with_certificate(self)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers under the keys of the command line.

        Returns
        -------
        dict
            criterion, loss, bound, gap, support, efficiency_white, status and more.
        """
        real = self.spectrum.n_inputs == 1
        entries = lambda P: (
            float(P[0, 0].real) if real else [[[z.real, z.imag] for z in row] for row in P.tolist()]
        )
        return {
            "criterion": self.criterion.name,
            **{k: getattr(self, k) for k in ("loss", "bound", "gap", "efficiency_white", "solver", "rounds")},
            "support": [
                {"frequency": float(w), "power": entries(P)}
                for w, P in zip(self.spectrum.omega, self.spectrum.power, strict=True)
            ],
            "status": self.status.name,
            "input_power": self.spectrum.total_power,
            "power_used": dict(self.power_used),
            "limits": dict(self.limits),
            "largest_price": self.certificate.largest_price,
            "price_beside_grid": self.certificate.elsewhere,
            "parameters": list(self.names),
            "information": self.information.tolist(),
        }

    def __str__(self) -> str:
        return in_words(self)

    def __repr__(self) -> str:
        return (
            f"Design({self.criterion.name}: loss {self.loss:.9g}, gap {self.gap:.1e}, {len(self.spectrum)} lines, "
            f"{self.status.name})"
        )
