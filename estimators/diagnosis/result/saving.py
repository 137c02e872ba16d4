"""A diagnosis written to a folder: the result as JSON, the simulated outputs as CSV, the model."""

import json
import os
from pathlib import Path

import numpy as np

from estimators.diagnosis.result.report import Diagnosis
from oed.files.writing import new_folder, write_whole


def save(result: Diagnosis, folder: str | os.PathLike[str]) -> Path:
    """Write a diagnosis to a new folder."""
    path = new_folder(folder)
    data = {k: v for k, v in result.to_dict().items() if k not in ("yhat_before", "yhat_after")}

    def clean(value: object) -> object:
        if isinstance(value, float) and not np.isfinite(value):
            return None
        if isinstance(value, np.generic):
            return clean(value.item())
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items()}
        return [clean(v) for v in value] if isinstance(value, list | tuple) else value

    write_whole(path / "diagnosis.json", json.dumps(clean(data), indent=1, allow_nan=False) + "\n")
    ny = result.yhat_before.shape[1]
    names = [f"{when}{i + 1}" for when in ("before", "after") for i in range(ny)]
    rows = np.concatenate((result.yhat_before, result.yhat_after), axis=1)
    lines = [",".join(names)] + [",".join(f"{v:.10g}" for v in row) for row in rows]
    write_whole(path / "simulated.csv", "\n".join(lines) + "\n")
    write_whole(path / "summary.txt", str(result) + "\n")
    if result.model is not None:
        result.model.save(path / "model.json")
    return path
