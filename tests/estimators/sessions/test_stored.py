"""A session in a folder: a rig driven through files alone, bad files in one line, and the session unharmed."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from estimators.norm.gains import gain
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import run
from estimators.sessions import FlaggedMeasurement, Settings, open_session, start_session
from estimators.sessions.estimates import estimate_of
from estimators.sessions.rest import rest_of
from oed.errors import CampaignError, InputError
from oed.experiments import simulated
from oed.plants.named import named_plant

AVIS = named_plant("avis", 0.01)
CHANNELS = {
    "inputs": ("fz", "mphi"), "outputs": ("z", "phi"), "input_units": ("N", "Nm"), "output_units": ("mm", "rad"),
}  # fmt: skip
ISOLATION = Settings("procedure-2", samples=300, dt=0.001, experiments=15, seed=4, **CHANNELS)


def table(file: Path) -> np.ndarray:
    return np.loadtxt(file, delimiter=",", skiprows=1)


def write(file: Path, header: str, columns: np.ndarray) -> Path:
    rows = [",".join(map(repr, row)) for row in columns.tolist()]
    file.write_text("\n".join([header, *rows]) + "\n")
    return file


def rig(file: Path, out: Path, experiment) -> Path:
    """What a rig does: reads the input's columns, applies them, writes its own file."""
    given = table(file)
    return write(out, "t_s,z_mm,phi_rad", np.column_stack([given[:, 0], experiment(given[:, 1:])]))


def state(folder: Path) -> dict[str, bytes]:
    return {f.name: f.read_bytes() for f in folder.iterdir() if f.name not in ("lock", "journal.txt")}


def test_the_vibration_isolation_rig_through_files_alone_is_the_direct_call_bit_for_bit(tmp_path):
    direct = run(
        partial(procedure_2, scaling="each"), simulated(AVIS, seed=9),
        samples=300, experiments=15, rng=np.random.default_rng(4),
    )  # fmt: skip
    folder, experiment = tmp_path / "rig", simulated(AVIS, seed=9)
    start_session(folder, ISOLATION)
    while (file := open_session(folder).next_input()) is not None:  # opened anew for every step
        assert file.read_text().startswith("t_s,fz_N,mphi_Nm\n0.0,")
        assert open_session(folder).next_input() == file
        step, stored = open_session(folder).record(rig(file, tmp_path / "measured.csv", experiment))
        assert stored.name == f"output-{step:04d}.csv"
    session = open_session(folder)
    for mine, theirs in zip(session.trace.records, direct.records, strict=True):
        np.testing.assert_array_equal(mine.u, theirs.u)
        np.testing.assert_array_equal(mine.y, theirs.y)
    mine, theirs = session.estimate(), estimate_of(ISOLATION, direct, direct)
    assert (mine.value, mine.standard_error, mine.frequency) == (
        theirs.value,
        theirs.standard_error,
        theirs.frequency,
    )
    np.testing.assert_array_equal(mine.direction, theirs.direction)
    assert mine.gains == tuple(gain(direct).values)
    assert session.status()["status"] == "BUDGET"


@pytest.fixture
def waiting(tmp_path):
    """A session that waits for the output of step 3, its folder, and the right file."""
    folder, experiment = tmp_path / "rig", simulated(AVIS, seed=1)
    session = start_session(folder, ISOLATION)
    for _ in range(2):
        session.record(rig(session.next_input(), tmp_path / "measured.csv", experiment))
    right = rig(session.next_input(), tmp_path / "right.csv", experiment)
    return folder, right, tmp_path


def cut(n):
    def change(text, rows):
        return text[:n]

    return change


def with_header(header):
    return lambda text, rows: "\n".join([header, *rows]) + "\n"


@pytest.mark.parametrize(
    "name, change, sentence",
    [
        ("output-0002.csv", lambda text, rows: text, "by its name the output of step 2"),
        ("input-0003.csv", lambda text, rows: text, "by its name the input of step 3"),
        ("m.csv", with_header("t_s,fz_N,mphi_Nm"), "has no column z, phi .it looks like an input file"),
        ("m.csv", with_header("t_s,a,b"), "has no column z, phi; its columns are t_s, a, b"),
        ("m.csv", lambda text, rows: text[:-1], "does not end with a line break"),
        ("m.csv", lambda text, rows: "t_s,z,phi\n" + "\n".join(rows[:-1]) + "\n0.299,1.0\n", "2 entries"),
        ("m.csv", cut(0), "empty"),
        ("m.csv", lambda text, rows: "t_s,z,phi\n" + "\n".join(rows[:200]) + "\n", "too few samples: 200"),
        ("m.csv", lambda text, rows: "z,phi\n" + "0.1,0.2\n" * 301, "too many samples: 301"),
        ("m.csv", lambda text, rows: text.replace("0.001,", "0.0015,", 1), "is not uniform"),
        ("m.csv", lambda text, rows: "t,z,phi\n" + "".join(f"{k / 500},{k}.5,{k * k}\n" for k in range(300)),
         "sampling time of m.csv is 0.002 s and that of the session 0.001"),
        ("m.csv", lambda text, rows: "z,phi,t_ms\n" + "".join(f"{k}.5,{k * k},{k * 2}\n" for k in range(300)),
         "sampling time of m.csv is 0.002 s and that of the session 0.001"),
        ("m.csv", with_header("t_s,z,z"), "m.csv has more than one column 'z'; give each"),
        ("m.csv", lambda text, rows: text.replace(rows[5].split(",")[1], "three"), "three"),
        ("m.bin", lambda text, rows: text, "suffix"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_one_clear_line_and_the_session_is_unharmed(waiting, name, change, sentence):
    folder, right, tmp = waiting
    before = state(folder)
    text = right.read_text()
    wrong = tmp / name
    wrong.write_text(change(text, text.splitlines()[1:]))
    with pytest.raises(InputError, match=sentence) as caught:
        open_session(folder).record(wrong)
    assert "\n" not in str(caught.value)
    assert state(folder) == before
    assert open_session(folder).record(right)[0] == 3


@pytest.mark.parametrize("said", [{"dt": 0.002}, {"fs": 500.0}], ids=str)
def test_a_sampling_time_that_a_file_states_is_checked_like_its_clock(waiting, said):
    """A record saved as npz has no column of times, and had been taken at any rate."""
    folder, right, tmp = waiting
    columns = dict(zip(("z", "phi"), table(right)[:, 1:].T, strict=True))
    np.savez(tmp / "m.npz", **columns, **said)
    with pytest.raises(InputError, match=r"sampling time of m.npz is 0.002 s and that of the session 0.001"):
        open_session(folder).record(tmp / "m.npz")
    np.savez(tmp / "m.npz", **columns, **{name: (0.001 if name == "dt" else 1000.0) for name in said})
    assert open_session(folder).record(tmp / "m.npz")[0] == 3


def test_the_output_of_another_step_is_known_again(waiting):
    folder, right, tmp = waiting
    with pytest.raises(InputError, match="this is the output of step 1, which is recorded"):
        open_session(folder).record(write(tmp / "m.csv", "t_s,z,phi", table(folder / "output-0001.csv")))
    assert open_session(folder).record(right)[0] == 3
    assert open_session(folder).record(right)[0] == 3  # the same command once more
    with pytest.raises(InputError, match="has no input yet"):
        open_session(folder).record(write(tmp / "m.csv", "t_s,z,phi", table(right) * [1, 2, 2]))


def test_recorded_inputs_show_swapped_channels(waiting):
    folder, right, tmp = waiting
    u, y = table(folder / "input-0003.csv")[:, 1:], table(right)[:, 1:]
    header = "fz,mphi,z,phi"
    with pytest.raises(InputError, match="input channels are swapped"):
        open_session(folder).record(write(tmp / "m.csv", header, np.column_stack([u[:, ::-1], y])))
    _, stored = open_session(folder).record(write(tmp / "m.csv", header, np.column_stack([u, y])))
    assert stored.read_text().startswith("t_s,fz_N,mphi_Nm,z_mm,phi_rad\n")
    assert open_session(folder).step == 4


def test_a_flagged_measurement_is_kept_and_repeated(waiting):
    folder, right, tmp = waiting
    columns = table(right)
    columns[7, 1] = np.nan
    bad = write(tmp / "m.csv", "t_s,z,phi", columns)
    for _ in range(2):  # the same bad file twice is kept once
        with pytest.raises(FlaggedMeasurement, match="1 samples of z are missing"):
            open_session(folder).record(bad)
    status = open_session(folder).status()
    assert [Path(f).name for f in status["flagged"]] == ["flagged-0003-1.csv"]
    assert status["status"] == "WAITING"
    assert "flagged-0003-1.csv" in (folder / "journal.txt").read_text()
    assert open_session(folder).record(right)[0] == 3


def test_an_abort_is_remembered_by_the_files(tmp_path):
    plant = named_plant("reference", 0.0)
    settings = Settings("power", samples=120, abort=2.0, experiments=4)
    folder = tmp_path / "rig"
    start_session(folder, settings)
    halved = 0
    while open_session(folder).step:
        session = open_session(folder)
        session.next_input()
        try:
            session.tell(plant.simulate(session.ask()))
        except FlaggedMeasurement:
            open_session(folder).next_input(reduce=True)
            halved += 1
    assert halved == len(list(folder.glob("input-*-2.csv"))) + len(list(folder.glob("input-*-3.csv"))) > 0
    whole = [np.abs(r.y).max() for r in open_session(folder).rig_records]
    assert max(whole) <= 2
    assert open_session(folder).estimate().gains[1:] == session.estimate().gains[1:]


def test_other_folders_are_refused(tmp_path, waiting):
    folder, _, _ = waiting
    with pytest.raises(CampaignError, match="holds another session .samples 300"):
        start_session(
            folder, Settings("procedure-2", samples=200, dt=0.001, experiments=15, seed=4, **CHANNELS)
        )
    assert start_session(folder, ISOLATION).step == 3
    with pytest.raises(CampaignError, match="there is no session in"):
        open_session(tmp_path / "nowhere")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(CampaignError, match="is not empty"):
        start_session(tmp_path / "full", ISOLATION)
    text = (folder / "session.json").read_text()
    (folder / "session.json").write_text(text.replace('"oed_session": 1', '"oed_session": 7'))
    with pytest.raises(CampaignError, match="written by another version"):
        open_session(folder)
    (folder / "session.json").write_text(text[:100])
    with pytest.raises(CampaignError, match="not JSON"):
        open_session(folder)


def test_changed_and_missing_files_are_noticed(waiting):
    folder, _, _ = waiting
    file = folder / "output-0001.csv"
    whole = file.read_text()
    file.write_text(whole.replace("\n0.0,", "\n0.0,1", 1))
    with pytest.raises(CampaignError, match=r"output-0001.csv was changed"):
        open_session(folder)
    file.unlink()
    with pytest.raises(CampaignError, match=r"output-0001.csv is missing"):
        open_session(folder)
    file.write_text(whole)
    other = folder / "input-0002.csv"
    kept = other.read_text()
    other.write_bytes((folder / "input-0001.csv").read_bytes())
    with pytest.raises(CampaignError, match="was changed"):
        open_session(folder)
    (folder / "journal.txt").unlink()  # without fingerprints the numbers themselves tell
    with pytest.raises(CampaignError, match="is not the input that step 2 of this session has"):
        open_session(folder)
    other.write_text(kept)
    assert open_session(folder).step == 3
    halved = folder / "input-0003-999999999.csv"  # as often as its name says, which took for ever
    halved.write_text(kept)
    with pytest.raises(CampaignError, match=r"input-0003-2.csv is missing"):
        open_session(folder)
    halved.unlink()
    (folder / "rest-output-0001.csv").write_text("t_s,z_mm,phi_rad\n0.0,1,2\n0.1,2,3\n")
    with pytest.raises(CampaignError, match=r"rest-input-0001.csv is missing"):
        rest_of(open_session(folder))
    (folder / "rest-input-0001.csv").write_text("t_s,fz_N,mphi_Nm\n0.0,1,2\n0.1,2,3\n")
    with pytest.raises(CampaignError, match="is no record of a rest test of this session"):
        rest_of(open_session(folder))


def test_a_full_disk_loses_nothing(waiting, monkeypatch):
    folder, right, _ = waiting
    before = state(folder)
    session = open_session(folder)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="the disk is full"):
            session.record(right)
    assert state(folder) == before
    assert session.record(right)[0] == 3


HOLD = """
import sys, time
from pathlib import Path
from oed.files.lock import locked
with locked(Path(sys.argv[1]) / "lock", "the session"):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_processes_and_a_dead_one(waiting):
    folder, right, _ = waiting
    other = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(
            CampaignError, match=f"another process .process {other.pid}. is working in the session"
        ):
            open_session(folder).record(right)
        assert open_session(folder).status()["status"] == "WAITING"  # reading needs no lock
    finally:
        other.kill()
        other.communicate()
    assert open_session(folder).record(right)[0] == 3  # the lock died with its process


def test_a_process_that_was_overtaken_says_so(waiting):
    folder, right, _ = waiting
    slow = open_session(folder)
    slow.ask()
    open_session(folder).record(right)
    with pytest.raises(InputError, match="step 3 was recorded meanwhile"):
        slow.tell(table(right)[:, 1:])


def test_settings_that_were_changed_are_named(tmp_path):
    folder = tmp_path / "rig"
    start_session(folder, Settings("power", samples=20, experiments=2, dt=0.01, seed=3))
    file = folder / "session.json"
    text = file.read_text()
    file.write_text(
        text.replace('"dt": 0.01', '"dt": 0.05')
    )  # no input depends on it, and every frequency in Hz
    with pytest.raises(
        CampaignError, match="session.json was changed after the session wrote it; restore it"
    ):
        open_session(folder)
    (folder / "journal.txt").unlink()  # of a session that was begun before settings had a fingerprint
    assert open_session(folder).settings.dt == 0.05


def test_what_was_taken_back_by_a_killed_command_is_not_held_against_its_next_measurement(tmp_path):
    """Two kills: of `undo` before its line of the journal, then of `record` before its own."""
    folder, experiment = tmp_path / "rig", simulated(AVIS, seed=9)
    start_session(folder, ISOLATION)
    file = rig(open_session(folder).next_input(), tmp_path / "measured.csv", experiment)
    open_session(folder).record(file)
    output, journal = folder / "output-0001.csv", folder / "journal.txt"
    output.rename(folder / "undone-output-0001-1.csv")
    open_session(folder).next_input()
    before = journal.read_text()
    open_session(folder).record(rig(folder / "input-0001.csv", tmp_path / "measured.csv", experiment))
    assert output.read_bytes() != (folder / "undone-output-0001-1.csv").read_bytes()
    journal.write_text(before)
    assert open_session(folder).step == 2


def test_one_bit_of_the_journal_changes_no_step_and_no_file(tmp_path):
    """The files are the state: a bit of a fingerprint is a line that names the file, a bit of anything else nothing."""
    folder, experiment = tmp_path / "rig", simulated(AVIS, seed=9)
    start_session(folder, ISOLATION)
    for _ in range(2):
        file = open_session(folder).next_input()
        open_session(folder).record(rig(file, tmp_path / "measured.csv", experiment))
    session = open_session(folder)
    session.undo()
    journal, kept = folder / "journal.txt", state(folder)
    whole, refused = journal.read_bytes(), []
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        journal.write_bytes(damaged)
        try:
            assert open_session(folder).step == 2
        except CampaignError as error:
            refused.append(str(error))
        assert state(folder) == kept
    assert len(refused) > 10
    assert all("was changed after the session wrote it" in line for line in refused)


def test_a_broken_line_of_the_journal_is_said_and_a_half_written_last_one_mended(tmp_path):
    folder, journal = tmp_path / "rig", tmp_path / "rig" / "journal.txt"
    start_session(folder, ISOLATION)
    file = open_session(folder).next_input()
    whole = journal.read_text()
    journal.write_text(whole[:-30])  # as a kill leaves it
    assert open_session(folder).status()["damage"] == []
    assert open_session(folder).next_input() == file
    marks = lambda text: [line.split()[1:] for line in text.splitlines()]
    assert [words[:4] for words in marks(journal.read_text())] == [words[:4] for words in marks(whole)]
    assert open_session(folder).status()["damage"] == []
    first, *others = whole.splitlines(keepends=True)
    journal.write_text("".join([first.replace("settings", "sett?ngs"), *others]))
    (said,) = open_session(folder).status()["damage"]
    assert said.startswith(f"Line 1 of {journal} is damaged: the fingerprint in it is lost")
