"""`oed plants`: the plants that `--plant` knows by name."""

import argparse

HELP = "the plants that --plant knows by name, each with its norm"
EXAMPLE = "oed plants"


def configure(parser: argparse.ArgumentParser) -> None:
    """There is nothing to set."""


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """The payload and the text: one row per plant."""
    from benchmarks.campaign.plants import load_plant, plant_names
    from oed import peak

    rows = []
    for name in plant_names():
        plant = load_plant(name)
        top = peak(plant)
        rows.append(
            {
                "name": name, "inputs": plant.n_inputs, "outputs": plant.n_outputs, "parameters": len(plant.free),
                "norm": top.value, "peak_frequency": top.frequency, "dt": plant.dt,
            }
        )  # fmt: skip
    head = f"{'name':18s} {'channels':9s} {'parameters':>10s} {'norm':>9s} {'at rad/sample':>14s}"
    lines = [
        f"{r['name']:18s} {r['outputs']} x {r['inputs']:<5d} {r['parameters']:10d} {r['norm']:9.4g} {r['peak_frequency']:14.4f}"
        for r in rows
    ]
    more = "random-fir-N is the N-th random FIR plant of the head-to-head; or give a JSON file, or a model.json of oed identify."
    return {"rows": rows}, "\n".join([head, *lines, more])
