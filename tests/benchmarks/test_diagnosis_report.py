"""`oed diagnose --out`: the folder, the page and what it says."""

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.commands.record import diagnose as command
from benchmarks.page.report import write_report


@pytest.mark.slow
def test_the_page_tells_the_cause_and_both_errors(tmp_path):
    rng = np.random.default_rng(3)
    files = []
    for name, start, n in (("train", 0, 400), ("test", 500, 200)):
        u = np.repeat(rng.uniform(-2, 2, n // 4), 4)
        y = lfilter([0.0, 0.1, 0.1], [1.0, -1.5, 0.7], np.clip(u, -1.1, 1.1)) + 0.02 * rng.standard_normal(n)
        rows = np.column_stack((np.arange(start, start + n), u, y))
        files.append(tmp_path / f"{name}.csv")
        np.savetxt(files[-1], rows, delimiter=",", header="t,u,y", comments="", fmt="%.9g")
    meta = tmp_path / "meta.json"
    meta.write_text(json.dumps({"sampling_time": 1.0, "structure": "SISO", "suggested_order": 2}))
    parser = command.argparse.ArgumentParser()
    command.configure(parser)
    out = tmp_path / "out"
    parser.add_argument("--quiet", action="store_true")
    args = parser.parse_args(
        [str(files[0]), "--quiet", "--test", str(files[1]), "--meta", str(meta), "--out", str(out)]
    )
    payload, _ = command.run(args)
    assert payload["effect"] == "input_saturation"
    page = (out / "report.html").read_text()
    assert "input saturation" in page
    assert page.count("<svg") == 2  # the residual, and the curve with its band
    assert "http" not in page.replace("http://www.w3.org", "").replace("https://matplotlib.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")  # opens offline: nothing is fetched
    rows = json.loads((out / "diagnosis.json").read_text())
    assert rows["rmse_after"] < 0.5 * rows["rmse_before"]
    before = page
    write_report(out)  # `oed report DIR` makes the same page again from what the folder holds
    assert (out / "report.html").read_text() == before
