"""What is true before any data is fitted: plants, spectra, information, optimal inputs and the theory.

The names below are imported when they are first used, so that `import oed` is quick.
"""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from oed.data import Record, Spectrum
    from oed.design import solve_design
    from oed.errors import ExperimentError, InputError, OedError, Status
    from oed.experiments import Experiment, replayed, simulated
    from oed.files import read_record, write_record
    from oed.information import information_of_records, information_of_signal, information_of_spectrum
    from oed.plants.json import plant_from_json, plant_to_json
    from oed.plants.named import named_plant
    from oed.plants.norms import peak
    from oed.plants.plant import Plant
    from oed.plants.systems import as_plant
    from oed.theory import limit_spectrum

__version__ = "0.2.0"

__all__ = [
    "Experiment", "ExperimentError", "InputError", "OedError", "Plant", "Record", "Spectrum", "Status",
    "as_plant", "information_of_records", "information_of_signal", "information_of_spectrum",
    "limit_spectrum", "named_plant", "peak", "plant_from_json", "plant_to_json", "read_record", "replayed",
    "simulated", "solve_design", "write_record",
]  # fmt: skip

__getattr__, __dir__ = exporting(__name__)
