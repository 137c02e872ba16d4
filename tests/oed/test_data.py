"""Records, spectra and experiments: shapes, refusals, limits, counting."""

import numpy as np
import pytest

from oed.data import Record, Spectrum, join
from oed.errors import ExperimentError, InputError, Status, check_names
from oed.experiments import Experiment, replayed, simulated
from oed.plants.named import named_plant


def test_one_channel_becomes_a_column_and_is_copied():
    u = np.arange(4.0)
    record = Record(u, u, dt=0.5, t0=2.0)
    u[0] = 9
    assert record.u.shape == (4, 1)
    assert record.u[0, 0] == 0
    assert list(record.t) == [2.0, 2.5, 3.0, 3.5]
    assert record.input_names == ("u",)
    part = record[1:3]
    assert len(part) == 2
    assert part.t0 == 2.5
    with pytest.raises(ValueError, match="read-only"):
        record.u[0] = 1


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Record([1, 2], [1]), ["2 samples", "output 1", "equal"]),
        (lambda: Record([1, np.inf], [1, 2]), ["not finite", "sample 1"]),
        (lambda: Record([], []), ["empty"]),
        (lambda: Record([1j], [1]), ["real numbers"]),
        (lambda: Record([1], [1], dt=-1), ["sampling time is -1"]),
        (lambda: Record([1], [1], t0=np.nan), ["first sample is nan"]),
        (lambda: Record([[1, 2]], [1], input_names=("a",)), ["1 input names for 2"]),
        (lambda: Record([1, 2, 3], [1, 2, 3])[5:9], ["empty"]),
        (lambda: Record(np.zeros((2, 2, 2)), [1, 2]), ["3 axes", "time on axis 0"]),
        (lambda: Spectrum([4.0], [1.0]), ["[0, pi]"]),
        (lambda: Spectrum([1.0], [-1.0]), ["negative power"]),
        (lambda: Spectrum([1.0], [[[1, 1j], [1j, 1]]]), ["Hermitian"]),
        (lambda: Spectrum([1.0, 2.0], [1.0]), ["(K,)"]),
        (lambda: join([Spectrum([1.0], [1.0]), Spectrum([1.0], [np.eye(2)])]), ["cannot be added"]),
        (lambda: check_names(["whit"], ("white", "power"), "method"), ["did you mean white?"]),
    ],
)
def test_bad_data_is_refused_in_words(make, words):
    with pytest.raises(InputError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)


def test_spectra_add_line_by_line():
    total = Spectrum([0.5, 1.0], [1.0, 2.0]) + 3 * Spectrum([1.0], [1.0])
    assert np.array_equal(total.omega, [0.5, 1.0])
    assert total.total_power == 6.0
    assert len(total.strongest(0.5)) == 1


def test_an_experiment_counts_and_checks():
    calls = []

    def rig(u):
        calls.append(u)
        return 2 * u[:, 0]

    experiment = Experiment(rig, amplitude=1.0)
    experiment([0.5, -1.0, 0.0])
    assert (
        experiment.used.experiments,
        experiment.used.samples,
        experiment.used.energy,
        experiment.used.peak,
    ) == (1, 3, 1.25, 1.0)
    with pytest.raises(InputError, match=r"reaches -2 at sample 1.*limit is 1.*Nothing was applied"):
        experiment([0.0, -2.0])
    assert len(calls) == 1
    with pytest.raises(InputError, match="2 channels and the system 1"):
        experiment(np.zeros((3, 2)))


@pytest.mark.parametrize(
    "answer, words",
    [
        (lambda u: u[:-1], "shape (2, 1)"),
        (lambda u: np.full(len(u), np.nan), "not finite"),
        (lambda u: "busy", "real numbers"),
    ],
)
def test_a_rig_that_answers_nonsense_is_named(answer, words):
    with pytest.raises(ExperimentError, match="experiment 1") as caught:
        Experiment(answer)(np.ones(3))
    assert words in str(caught.value)


def test_simulated_experiments_repeat_and_share_their_noise():
    plant = named_plant("reference")
    one, other = simulated(plant, seed=4, replicate=2), simulated(plant, seed=4, replicate=2)
    u = np.ones((50, 1))
    first = one(u)
    assert np.array_equal(first, other(u))
    e = first - plant.simulate(u)
    assert np.allclose(other(-u) - plant.simulate(-u), one(u) - plant.simulate(u))  # experiment 2 on both
    louder = simulated(plant.replace(noise_variance=4), seed=4, replicate=2)
    assert np.allclose(louder(u) - plant.simulate(u), 2 * e)


def test_replay_answers_only_what_was_asked():
    record = Record([1.0, 2.0], [3.0, 4.0])
    experiment = replayed([record])
    assert np.array_equal(experiment([1.0, 2.0]), record.y)
    with pytest.raises(ExperimentError, match="have been replayed"):
        experiment([1.0, 2.0])
    with pytest.raises(ExperimentError, match="differs from that of record 1"):
        replayed([record])([9.0, 9.0])


def test_every_status_says_a_sentence():
    for status in Status:
        assert status.value.endswith(".")
    assert Status.OK.ok
    assert not Status.NEGATIVE_SQUARE.ok


def test_a_signal_on_its_side_is_refused():
    """A 1 x N array is never one sample of N channels; one sample of a few channels is."""
    with pytest.raises(InputError, match="transpose"):
        Record(np.ones((1, 65)), np.ones((1, 65)))
    assert len(Record(np.ones((1, 3)), np.ones((1, 2)))) == 1
