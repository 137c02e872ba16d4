"""`oed demo`: a folder with something to try: a record, a plant, a campaign, and the commands to copy."""

import argparse

HELP = "write a folder to try things in: a record, a plant, a campaign, and the commands to copy"
EXAMPLE = "oed demo try-it"

CAMPAIGN = """# A small comparison: oed compare --config campaign.toml
plants = ["reference"]
noise_variances = [1]
methods = ["white", "power", "oracle-hinf"]
estimators = ["gain", "pem"]
samples = 500
experiments = 5
replicates = 20
out = "comparison"
"""
COMMANDS = """# The chain, from a record to the next experiment. Run these in this folder.
oed identify "record.csv[0:500]" --structure oe --orders 2 2 --delay auto --test "record.csv[500:1000]" --skip 20 --out model
oed diagnose "record.csv[0:500]" --test "record.csv[500:1000]" --skip 20 --out diagnosis
oed design --plant model/model.json --criterion D --amplitude 2 --realise 500 --out input.csv
oed theory --plant model/model.json
oed compare --plant model/model.json --noise-variance 0.0088 --methods white power sequential --estimators gain pem --replicates 20 --out mine
oed session start rig --method power --samples 500 --dt 0.08 --amplitude 2
oed session rest rig
oed session next rig
# Also: a plant file, a named plant, a small comparison.
oed design --plant plant.json --criterion hinf
oed iterate --plant reference --algorithm siso --samples 1000 --iterations 20 --noise-variance 1
oed compare --config campaign.toml
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """The folder."""
    parser.add_argument("folder", metavar="DIR", help="a new or empty folder")


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """The payload and the text: where the files are."""
    import json
    from importlib.resources import files

    from oed.files.writing import new_folder, write_whole
    from oed.plants.json import plant_to_json
    from oed.plants.named import named_plant

    folder = new_folder(args.folder, "DIR")
    shipped = files("benchmarks") / "data"
    contents = {
        "record.csv": (shipped / "hair_dryer.csv").read_text(encoding="utf-8"),
        "record-licence.md": (shipped / "README.md").read_text(encoding="utf-8"),
        "plant.json": json.dumps(plant_to_json(named_plant("reference")), indent=1) + "\n",
        "campaign.toml": CAMPAIGN,
        "commands.sh": COMMANDS,
    }
    for name, text in contents.items():
        write_whole(folder / name, text)
    rows = [{"file": str(folder / name)} for name in contents]
    said = f"written to {folder}: {', '.join(contents)}\n\ncd {folder}\n" + "".join(
        line + "\n" for line in COMMANDS.splitlines()
    )
    return {"path": str(folder), "rows": rows}, said.rstrip()
