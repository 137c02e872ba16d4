"""Two-stage and sequential optimal design: they redesign, and they carry more than white noise."""

import numpy as np
import pytest

from estimators.rules.adaptive import sequential, two_stage
from estimators.rules.inputs import white
from estimators.rules.trace import run
from oed.errors import InputError
from oed.experiments import simulated
from oed.information import information_of_records
from oed.plants.named import named_plant
from oed.plants.norms import gain_gradient

REFERENCE = named_plant("reference")


def c_efficiency(trace) -> float:
    """lambda_e N n / (c' I^-1 c) of what was applied, at unit power."""
    information = information_of_records(REFERENCE, [r.u for r in trace.records])
    c = gain_gradient(REFERENCE)
    return 1 / (trace.usage.energy * float(c @ np.linalg.solve(information, c)))


@pytest.mark.parametrize("make", [two_stage, sequential])
def test_designed_inputs_carry_several_times_what_white_noise_does(make):
    """White noise is 4.9 % efficient here; the margin of 6 is far from what the noise of one run can do."""
    trace = run(
        make((2, 2), 1, experiments=6),
        simulated(REFERENCE, seed=3),
        samples=400,
        experiments=6,
        rng=np.random.default_rng(3),
    )
    assert trace.kinds[0] == "white"
    assert trace.kinds[-1] == "designed"
    plain = run(white, simulated(REFERENCE, seed=3), samples=400, experiments=6, rng=np.random.default_rng(3))
    assert c_efficiency(trace) > 6 * c_efficiency(plain)
    assert np.allclose([np.mean(r.u**2) for r in trace.records], 1.0)


def test_a_model_that_cannot_be_fitted_leads_to_more_white_noise():
    trace = run(
        two_stage((2, 2), 1, experiments=3, share=0.3), simulated(REFERENCE.replace(noise_variance=1.0), seed=0),
        samples=4, experiments=3, rng=np.random.default_rng(0),
    )  # fmt: skip
    assert trace.usage.experiments == 3
    assert set(trace.kinds) <= {"white", "designed"}


@pytest.mark.parametrize("share", [0.0, 1.0, -1.0])
def test_the_share_is_checked(share):
    with pytest.raises(InputError, match="strictly between 0 and 1"):
        two_stage(share=share)


def width(u: np.ndarray) -> float:
    """Root mean square distance of the input's power from its mean frequency, rad/sample."""
    power = np.abs(np.fft.rfft(u[:, 0])) ** 2
    omega = 2 * np.pi * np.fft.rfftfreq(len(u))
    centre = np.sum(omega * power) / power.sum()
    return float(np.sqrt(np.sum((omega - centre) ** 2 * power) / power.sum()))


def test_the_hedged_design_narrows_as_the_peak_becomes_known():
    """White noise is 0.9 wide; after one experiment the peak is known to about 0.1, after 24 to a tenth of that."""
    noisy = REFERENCE.replace(noise_variance=4.0)
    options = {"samples": 400, "experiments": 25, "rng": np.random.default_rng(1)}
    trace = run(sequential((2, 2), 1, experiments=25), simulated(noisy, seed=1), **options)
    widths = [width(r.u) for r in trace.records]
    assert widths[0] > 0.8
    assert 0.02 < widths[1] < 0.8
    assert widths[-1] < 0.5 * widths[1]
    plain = run(
        sequential((2, 2), 1, experiments=4, draws=0),
        simulated(noisy, seed=1),
        samples=400,
        experiments=4,
        rng=np.random.default_rng(1),
    )
    assert plain.kinds == ("white", "designed", "designed", "designed")


def test_hedging_for_several_channels_puts_the_power_in_the_direction_of_the_peak():
    """3 x 2 at little noise: the design is the sinusoid of the true peak, in both channels, to a line."""
    from oed.plants.norms import peak

    plant = named_plant("three-by-two").replace(noise_variance=1e-6)
    orders = [[2, 1], [1, 1], [2, 2]], [[2, 1], [1, 2], [2, 2]]
    delay = [[1, 1], [1, 2], [1, 1]]
    trace = run(
        sequential(orders, delay, experiments=2),
        simulated(plant),
        samples=400,
        experiments=2,
        rng=np.random.default_rng(0),
    )
    top = peak(plant)
    v = np.linalg.svd(plant.response([top.frequency])[0][0])[2][0].conj()
    U = np.fft.rfft(trace.records[1].u, axis=0)
    k = int(np.argmax(np.sum(np.abs(U) ** 2, axis=1)))
    assert abs(2 * np.pi * k / 400 - top.frequency) <= 2 * np.pi / 400
    assert abs(np.vdot(v, U[k])) > 0.999 * np.linalg.norm(U[k])


@pytest.mark.parametrize("options", [{"draws": -1}, {"inflation": 0.0}])
def test_the_hedge_is_checked(options):
    with pytest.raises(InputError, match="give draws >= 0 and inflation > 0"):
        sequential(**options)


@pytest.mark.parametrize(
    "make, criterion", [(sequential, "D"), (sequential, "static-gain"), (two_stage, "hinf")]
)
@pytest.mark.parametrize("unit", [2.0**133, 2.0**-133])
def test_outputs_in_other_units_are_answered_by_the_same_inputs(make, criterion, unit):
    """At gains of 1e40 white noise had been applied throughout, without a word, or a traceback had ended it."""
    plant = named_plant("reference", 0.01)
    other = plant.replace(num=[[unit * plant.num[0][0]]], noise_variance=0.01 * unit**2)
    traces = [
        run(
            make((2, 2), 1, criterion=criterion, experiments=4),
            simulated(p, seed=1),
            samples=200,
            experiments=4,
            rng=1,
        )
        for p in (plant, other)
    ]
    assert traces[0].kinds == traces[1].kinds == ("white", "designed", "designed", "designed")
    for one, two in zip(*(trace.records for trace in traces), strict=True):
        assert np.allclose(one.u, two.u, atol=1e-6)
