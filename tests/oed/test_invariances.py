"""What may not change when units, labels, time or parameters are changed, on plants that hypothesis thinks of.

Nothing is computed a second way here: the suite is compared with itself, on two descriptions of the same thing. Scalings are powers
of two where equality to the last bits is meant, arbitrary otherwise.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from estimators.norm.gains import gain, mu
from estimators.rules.power import power_iterations
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import run
from oed.data import Spectrum
from oed.experiments import Experiment
from oed.information import information_of_signal, information_of_spectrum
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.limit import limit_spectrum

CHANNELS = st.integers(1, 3)
UNITS = st.floats(-6, 6).map(lambda x: 10.0**x)


@st.composite
def denominators(draw, largest: float = 0.97):
    """Real poles and complex pairs, up to order 4, radius up to `largest`."""
    den = np.ones(1)
    for _ in range(draw(st.integers(0, 2))):
        radius, angle = draw(st.floats(0.0, largest)), draw(st.floats(0.0, np.pi))
        if draw(st.booleans()):
            den = np.convolve(den, [1.0, -2 * radius * np.cos(angle), radius**2])
        else:
            den = np.convolve(den, [1.0, radius * np.cos(angle)])
    return den


@st.composite
def numerators(draw):
    delay = draw(st.integers(0, 3))
    taps = draw(st.lists(st.floats(-1, 1).map(lambda x: round(x, 3)), min_size=1, max_size=3))
    taps[0] = taps[0] if abs(taps[0]) > 0.05 else 0.5
    return np.r_[np.zeros(delay), taps]


@st.composite
def plants(draw, outputs=CHANNELS, inputs=CHANNELS, largest: float = 0.97):
    p, q = draw(outputs), draw(inputs)
    num = [[draw(numerators()) for _ in range(q)] for _ in range(p)]
    den = [[draw(denominators(largest)) for _ in range(q)] for _ in range(p)]
    return Plant(num, den, noise_covariance=draw(st.floats(0.01, 10.0)))


def siso(largest: float = 0.97):
    return plants(st.just(1), st.just(1), largest)


def scaled(plant: Plant, output, inverse_input) -> Plant:
    """The same plant in other units: y' = R y, u' = S u, so that num' = R num / S and Lambda' = R Lambda R."""
    r, s = np.broadcast_to(output, plant.n_outputs), np.broadcast_to(inverse_input, plant.n_inputs)
    num = [[r[i] * b / s[j] for j, b in enumerate(row)] for i, row in enumerate(plant.num)]
    return plant.replace(num=num, noise_covariance=np.outer(r, r) * plant.noise_covariance)


def slopes(plant: Plant, output, inverse_input) -> np.ndarray:
    """d theta / d theta' of that change: s / r for numerators, 1 for denominators."""
    r, s = np.broadcast_to(output, plant.n_outputs), np.broadcast_to(inverse_input, plant.n_inputs)
    return np.array([s[j] / r[i] if letter == "b" else 1.0 for _, letter, _, i, j, _ in plant._parameters()])


def relabelled(plant: Plant, rows, columns) -> Plant:
    pick = lambda m: [[m[i][j] for j in columns] for i in rows]
    covariance = plant.noise_covariance[np.ix_(rows, rows)]
    return plant.replace(num=pick(plant.num), den=pick(plant.den), noise_covariance=covariance, free=())


def order(plant: Plant, rows, columns) -> np.ndarray:
    """Where the parameters of the relabelled plant are among those of the plant."""
    place = {(row[1], row[2], row[3], row[4]): k for k, row in enumerate(plant._parameters())}
    other = relabelled(plant, rows, columns)._parameters()
    return np.array([place[letter, power, rows[i], columns[j]] for _, letter, power, i, j, _ in other])


def mirrored(plant: Plant) -> Plant:
    """G(-z): every frequency w becomes pi - w."""
    flip = lambda m: [[b * (-1.0) ** np.arange(len(b)) for b in row] for row in m]
    return plant.replace(num=flip(plant.num), den=flip(plant.den))


def lines(draw_seed: int, channels: int) -> Spectrum:
    rng = np.random.default_rng(draw_seed)
    root = rng.standard_normal((5, channels, channels)) + 1j * rng.standard_normal((5, channels, channels))
    return Spectrum(rng.uniform(0.05, 3.1, 5), root @ root.conj().transpose(0, 2, 1))


def close(value, expected, tolerance: float = 1e-10) -> None:
    """Matrices entry by entry in units of the expected diagonal's roots; an absent parameter has an exact zero."""
    size = np.sqrt(np.diag(expected))
    size = np.where(size > 0, size, 1.0)
    assert np.abs((value - expected) / np.outer(size, size)).max() < tolerance


@given(plants(), UNITS, UNITS, st.integers(0, 99))
@settings(max_examples=40)
def test_information_in_other_units(plant, output, inputs, seed) -> None:
    other, j = scaled(plant, output, inputs), slopes(plant, output, inputs)
    spectrum = lines(seed, plant.n_inputs)
    close(
        information_of_spectrum(other, spectrum * inputs**2),
        np.outer(j, j) * information_of_spectrum(plant, spectrum),
    )
    u = np.random.default_rng(seed).standard_normal((20, plant.n_inputs))
    close(information_of_signal(other, inputs * u), np.outer(j, j) * information_of_signal(plant, u))


@given(plants(), st.randoms(use_true_random=False), st.integers(0, 99))
@settings(max_examples=40)
def test_information_of_relabelled_channels(plant, shuffle, seed) -> None:
    rows, columns = list(range(plant.n_outputs)), list(range(plant.n_inputs))
    shuffle.shuffle(rows)
    shuffle.shuffle(columns)
    other, at = relabelled(plant, rows, columns), order(plant, rows, columns)
    spectrum = lines(seed, plant.n_inputs)
    moved = Spectrum(spectrum.omega, spectrum.power[:, columns][:, :, columns])
    close(information_of_spectrum(other, moved), information_of_spectrum(plant, spectrum)[np.ix_(at, at)])
    u = np.random.default_rng(seed).standard_normal((20, plant.n_inputs))
    close(information_of_signal(other, u[:, columns]), information_of_signal(plant, u)[np.ix_(at, at)])


@given(plants(), st.integers(0, 99), st.integers(1, 5))
@settings(max_examples=40)
def test_information_in_other_time(plant, seed, delay) -> None:
    """Delay of the plant, a wait before the signal, and the mirror image of all frequencies."""
    spectrum = lines(seed, plant.n_inputs)
    expected = information_of_spectrum(plant, spectrum)
    late = plant.replace(num=[[np.r_[np.zeros(delay), b] for b in row] for row in plant.num], free=())
    close(information_of_spectrum(late, spectrum), expected)
    u = np.random.default_rng(seed).standard_normal((20, plant.n_inputs))
    waiting = np.vstack([np.zeros((delay, plant.n_inputs)), u])
    close(information_of_signal(plant, waiting), information_of_signal(plant, u))
    sign = np.array([(-1.0) ** power for _, _, power, _, _, _ in plant._parameters()])
    # conj: the line at pi - w of G(-z) is the conjugate of the line at w
    other = Spectrum(np.pi - spectrum.omega, spectrum.power.conj())
    close(information_of_spectrum(mirrored(plant), other), np.outer(sign, sign) * expected)


@given(siso(), denominators(0.8), denominators(0.8), st.integers(0, 99))
@settings(max_examples=40)
def test_noise_filter_is_a_prefilter(plant, above, below, seed) -> None:
    """SISO: noise H e and input u inform as white noise and input H^-1 u do."""
    from scipy.signal import lfilter

    coloured = plant.replace(noise_num=above, noise_den=below)
    u = np.random.default_rng(seed).standard_normal((40, 1))
    close(
        information_of_signal(coloured, u),
        information_of_signal(plant, np.asarray(lfilter(below, above, u, axis=0))),
        1e-8,
    )
    spectrum = lines(seed, 1)
    power = spectrum.power[:, 0, 0].real / np.abs(coloured.noise_response(spectrum.omega)) ** 2
    close(
        information_of_spectrum(coloured, spectrum),
        information_of_spectrum(plant, Spectrum(spectrum.omega, power)),
    )


@given(plants(), UNITS, st.randoms(use_true_random=False), st.integers(1, 4))
@settings(max_examples=25)
def test_norm(plant, unit, shuffle, delay) -> None:
    """Units scale it; labels, transposition, delay, sign and mirror image leave it."""
    found = peak(plant)
    other = peak(scaled(plant, unit, 1.0))
    assert other.value == pytest.approx(unit * found.value, rel=1e-10, abs=0)
    assert other.upper_bound == pytest.approx(unit * found.upper_bound, rel=1e-9, abs=0)
    rows, columns = list(range(plant.n_outputs)), list(range(plant.n_inputs))
    shuffle.shuffle(rows)
    shuffle.shuffle(columns)
    flip = lambda m: [list(row) for row in zip(*m)]
    late = [[np.r_[np.zeros(delay), -b] for b in row] for row in plant.num]
    for same in (
        relabelled(plant, rows, columns),
        plant.replace(num=flip(plant.num), den=flip(plant.den), noise_covariance=1.0, free=()),
        plant.replace(num=late, free=()),
        mirrored(plant),
    ):
        assert peak(same).value == pytest.approx(found.value, rel=1e-10)
    if found.unique:
        # heights within 1e-9 of the best may swap which of them is called the peak: compare the gain there
        assert peak(mirrored(plant)).frequencies == pytest.approx((np.pi - found.frequency,), abs=1e-4)


@given(st.integers(0, 999), st.integers(1, 3), st.integers(1, 3))
@settings(max_examples=40)
def test_norm_of_rotated_channels(seed, p, q) -> None:
    """FIR plants may be mixed by orthogonal matrices: gamma stays, the singular vectors turn with them."""
    rng = np.random.default_rng(seed)
    taps = rng.standard_normal((5, p, q))
    left, right = np.linalg.qr(rng.standard_normal((p, p)))[0], np.linalg.qr(rng.standard_normal((q, q)))[0]
    make = lambda g: Plant([[g[:, i, j] for j in range(q)] for i in range(p)], [[[1.0]] * q] * p)
    one, two = peak(make(taps)), peak(make(left @ taps @ right))
    assert two.value == pytest.approx(one.value, rel=1e-11)
    assume(one.unique)
    assert two.frequency == pytest.approx(one.frequency, abs=1e-6)
    assert two.curvature == pytest.approx(one.curvature, rel=1e-5, abs=1e-8)
    assert abs(one.input_direction.conj() @ right @ two.input_direction) == pytest.approx(1.0, abs=1e-6)


@given(plants(), UNITS, UNITS)
@settings(max_examples=40)
def test_gain_gradient_scales_and_closes(plant, output, inputs) -> None:
    """Units, and Euler: gamma is homogeneous of degree one in the numerators, c' b = gamma (theory 4: c'x = 1)."""
    found = peak(plant)
    s = np.linalg.svd(plant.response(found.frequency)[0][0], compute_uv=False)
    assume(found.unique and (len(s) == 1 or s[1] < 0.999 * s[0]))
    c = gain_gradient(plant, found)
    numerators_ = np.array([name.startswith("b") for name in plant.free])
    assert c[numerators_] @ plant.theta[numerators_] == pytest.approx(found.value, rel=1e-9)
    other = scaled(plant, output, inputs)
    # c' = d gamma' / d theta' = (r / s) c (d theta / d theta')
    expected = output / inputs * c * slopes(plant, output, inputs)
    assert gain_gradient(other) == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())


@given(siso(), UNITS, st.integers(1, 4))
@settings(max_examples=40)
def test_limit_spectrum_in_other_units_and_time(plant, unit, delay) -> None:
    found = limit_spectrum(plant)
    other = limit_spectrum(scaled(plant, unit, 1.0))
    assert other.mu2_excess == pytest.approx(unit**2 * found.mu2_excess, rel=1e-8, abs=0)
    assert other.beta2_mean == pytest.approx(
        unit**2 * found.beta2_mean, rel=1e-8, abs=unit**2 * 1e-10 * found.mu2
    )
    assert other.spectrum_max == pytest.approx(found.spectrum_max, rel=1e-8)
    assert other.spectrum_min == pytest.approx(found.spectrum_min, rel=1e-8)
    late = plant.replace(num=[[np.r_[np.zeros(delay), -plant.num[0][0]]]], free=())
    for same in (late, mirrored(plant)):
        assert limit_spectrum(same).mu2_excess == pytest.approx(found.mu2_excess, rel=1e-8, abs=0)
    w = np.linspace(0.1, 3.0, 7)
    assert limit_spectrum(mirrored(plant)).density(np.pi - w) == pytest.approx(found.density(w), rel=1e-7)
    # [S] Theorem 8 and (9)-(12) on whatever plant this is
    assert found.mu2_excess > 0
    assert found.beta2_mean <= found.peak.value**2 * (1 + 1e-12)
    assert found.spectrum.total_power == pytest.approx(1.0, rel=1e-9)


@given(siso(), st.floats(1.5, 100.0))
@settings(max_examples=40)
def test_limit_spectrum_grows_with_the_noise(plant, factor) -> None:
    """[S] Theorem 8 (4): mu strictly increases with lambda_e. The excess grows at least by the factor, and never beyond lambda_e:
    1 / (c delta + f) >= 1 / (c (delta + f)), and f >= 0.
    """
    low = limit_spectrum(plant).mu2_excess
    noise = factor * plant.noise_covariance
    high = limit_spectrum(plant.replace(noise_covariance=noise)).mu2_excess
    assert factor * low <= high * (1 + 1e-9)
    assert high <= noise[0, 0] * (1 + 1e-12)


@pytest.mark.parametrize("num, den", [([0.0, 1.0], [1.0]), ([-0.5, 1.0], [1.0, -0.5])])
def test_all_pass(num, den) -> None:
    """Every frequency is a peak: white noise stays white, mu^2 = gamma^2 + lambda_e, and the peak is not unique."""
    plant = Plant(num, den, noise_covariance=0.3)
    found = peak(plant)
    assert found.value == pytest.approx(1.0, rel=1e-14)
    assert not found.unique
    limit = limit_spectrum(plant)
    assert limit.mu2_excess == pytest.approx(0.3, rel=1e-12)
    assert limit.spectrum_max == pytest.approx(1.0, rel=1e-12)
    assert limit.spectrum_min == pytest.approx(1.0, rel=1e-12)


def noisy(plant: Plant, seed: int, unit=1.0, rows=None, columns=None) -> Experiment:
    """The plant with noise of its own seed; the same system in other units or with other labels."""
    p, q = plant.n_outputs, plant.n_inputs
    rows, columns = rows or list(range(p)), columns or list(range(q))
    rng = np.random.default_rng(seed)

    def apply(u):
        inner = np.empty_like(u)
        inner[:, columns] = u
        y = plant.simulate(inner) + 0.3 * rng.standard_normal((len(u), p))
        return unit * y[:, rows]

    return Experiment(apply, q, p)


@given(siso(0.9), UNITS, st.integers(0, 99))
@settings(max_examples=40)
def test_iterations_in_other_units(plant, unit, seed) -> None:
    start = np.random.default_rng(seed).standard_normal((24, 1))
    traces = [
        run(
            partial(power_iterations, start=x),
            noisy(plant, seed, r),
            samples=24,
            experiments=8,
            rng=np.random.default_rng(0),
        )
        for x, r in ((start, 1.0), (3.0 * start, unit))
    ]
    for one, two in zip(traces[0].records, traces[1].records, strict=True):
        assert two.u == pytest.approx(one.u, rel=1e-8, abs=1e-8)
        assert two.y == pytest.approx(unit * one.y, rel=1e-8, abs=1e-8 * unit)
    for estimator, power in ((gain, 2), (mu, 1)):
        one, two = (estimator(trace) for trace in traces)
        if power == 2:
            assert two.squares[1:] == pytest.approx(unit**2 * one.squares[1:], rel=1e-6, abs=1e-7 * unit**2)
        else:
            assert two.values == pytest.approx(unit * one.values, rel=1e-8, abs=0)


@given(plants(largest=0.9), st.randoms(use_true_random=False), st.integers(0, 99))
@settings(max_examples=25)
@pytest.mark.parametrize("scaling", ["none", "each", "common"])
def test_procedure_2_with_other_labels(scaling, plant, shuffle, seed) -> None:
    """Without noise (its order would change with the labels) the channels may be called what one likes."""
    rows, columns = list(range(plant.n_outputs)), list(range(plant.n_inputs))
    shuffle.shuffle(rows)
    shuffle.shuffle(columns)
    start = np.random.default_rng(seed).standard_normal((16, plant.n_inputs))
    each = 1 + plant.n_inputs * plant.n_outputs
    traces = [
        run(
            partial(procedure_2, start=x, scaling=scaling),
            Experiment(system.simulate, plant.n_inputs, plant.n_outputs),
            samples=16,
            experiments=4 * each,
            rng=np.random.default_rng(0),
        )
        for x, system in ((start, plant), (start[:, columns], relabelled(plant, rows, columns)))
    ]
    assert gain(traces[1]).values == pytest.approx(gain(traces[0]).values, rel=1e-9, abs=1e-12)
    last = [trace.records[trace.iterations[-1]][0].u for trace in traces]
    assert last[1] == pytest.approx(last[0][:, columns], abs=1e-8)
