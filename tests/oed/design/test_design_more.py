"""Criteria by name, other parametrisations, robust, closed-loop and least-power designs, textbook optima."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from oed.criteria import c_criterion, d_criterion, g_criterion
from oed.data import Spectrum
from oed.design import InformationMap, information_map, solve_design
from oed.design.parametrisations.autocorrelation import autocorrelation_design, moment_design
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.questions.closed_loop import closed_loop_map
from oed.design.questions.least_power import application_criterion, least_power_design
from oed.design.questions.robust import robust_design
from oed.errors import InfeasibleDesign, InputError
from oed.models.model import Model, bj
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant

OPTIMA = {"D": 0.033674015758, "A": 0.339118600620, "E": 0.230078614237, "hinf": 1.0}


@pytest.fixture(scope="module")
def plant():
    return named_plant("reference")


@pytest.mark.parametrize("name", OPTIMA)
def test_moments_agree_with_the_grid(plant, name):
    found = moment_design(plant, name)
    # Clarabel's semidefinite programme: 1e-8 relative seen, 1e-7 asked for.
    assert found.loss == pytest.approx(OPTIMA[name], rel=1e-7)
    assert found.spectrum.total_power == pytest.approx(1.0, rel=1e-12)
    near = solve_design(plant, name).spectrum.omega
    np.testing.assert_allclose(found.spectrum.omega, near, atol=1e-4)


def test_autocorrelation_approaches_from_above(plant):
    lags = [4, 8, 16, 32]
    losses = [autocorrelation_design(plant, "D", lags=L).loss for L in lags]
    assert np.all(np.diff(losses) < 0)
    assert losses[-1] > OPTIMA["D"]
    # White noise is the design without lags.
    none = autocorrelation_design(plant, "D", lags=0)
    assert none.loss == pytest.approx(0.220591954, rel=1e-8)
    one = autocorrelation_design(plant, "D", lags=8)
    assert one.coefficients[0] == pytest.approx(1.0)
    assert one.spectrum.total_power == pytest.approx(1.0, rel=1e-12)


def test_gradients_of_named_scalars_by_differences(plant):
    gain = lambda p, w: float(np.abs(p.response([w])[0][0, 0, 0]))
    poles = lambda p: np.roots(p.den[0][0])[0]
    damping = lambda p: float(-np.log(poles(p)).real / abs(np.log(poles(p))))
    cases = {
        "static-gain": lambda p: gain(p, 0.0),
        "gain:0.5": lambda p: gain(p, 0.5),
        "hinf": lambda p: peak(p).value,
        "pole:1": lambda p: float(abs(poles(p))),
        "damping:1": damping,
    }
    for name, function in cases.items():
        exact = criterion_of(name, plant, information_map(plant)).V[:, 0]
        by_differences = [
            (function(plant.with_theta(plant.theta + h)) - function(plant.with_theta(plant.theta - h))) / 2e-6
            for h in 1e-6 * np.eye(len(plant.theta))
        ]
        np.testing.assert_allclose(exact, by_differences, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    "name, value", [("pole:1", 0.9), ("damping:1", -np.log(0.9) / np.hypot(np.log(0.9), np.pi))]
)
def test_of_real_poles_the_least_damped_is_first_a_negative_one_too(name, value):
    """Its logarithm was no number, and which pole came first was chance."""
    plant = Plant([0, 1.0], np.poly([0.5, -0.9]))
    gradient = criterion_of(name, plant, information_map(plant)).V[:, 0]
    least = lambda p: min(np.roots(p.den[0][0]))
    function = (
        (lambda p: abs(least(p)))
        if name == "pole:1"
        else lambda p: -np.log(abs(x := least(p))) / abs(np.log(complex(x)))
    )
    assert function(plant) == pytest.approx(value)
    by_differences = [
        (function(plant.with_theta(plant.theta + h)) - function(plant.with_theta(plant.theta - h))) / 2e-6
        for h in 1e-6 * np.eye(len(plant.theta))
    ]
    np.testing.assert_allclose(gradient, by_differences, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["Ds:b1,b2", "static-gain", "gain:0.5", "pole:1", "damping:1", "I"])
def test_named_criteria_close_their_gap(plant, name):
    design = solve_design(plant, name)
    assert abs(design.gap) < 1e-9
    assert design.certificate.check(points=20_001) <= 1 + 1e-9


def test_information_of_a_box_jenkins_model_has_the_noise_part():
    model = Model(bj(2, 1, 1, 2), [0.2, 0.1, 0.3, -0.4, -0.9, 0.8], noise_covariance=0.5)
    found = information_map(model)
    # B, F and C, D are estimated independently; AR and MA parts have the textbook information.
    names = list(found.names)
    c, d = names.index("c1"), names.index("d1")
    assert found.constant[c, c] == pytest.approx(1 / (1 - 0.3**2), rel=1e-10)
    assert found.constant[d, d] == pytest.approx(1 / (1 - 0.4**2), rel=1e-10)
    assert solve_design(model, "D").gap < 1e-7


def test_closed_loop_without_feedback_is_open_loop(plant):
    zero = lambda omega: np.zeros((len(omega), 1, 1), dtype=complex)
    closed = solve_design(closed_loop_map(plant, zero), "D")
    assert closed.loss == pytest.approx(OPTIMA["D"], rel=1e-9)
    weak = lambda omega: np.full((len(omega), 1, 1), 0.2 + 0j)
    assert solve_design(closed_loop_map(plant, weak), "D").gap < 1e-7
    strong = lambda omega: np.full((len(omega), 1, 1), 20.0 + 0j)
    with pytest.raises(InputError, match="closed loop is unstable"):
        closed_loop_map(plant, strong)


def test_robust_designs_collapse_and_are_worst_case(plant):
    assert robust_design([plant, plant], "D").loss == pytest.approx(OPTIMA["D"], rel=1e-8)
    assert robust_design([plant], "A").loss == pytest.approx(OPTIMA["A"], rel=1e-8)
    other = plant.replace(den=[1, -0.8, 0.75])
    worst = robust_design([plant, other], "E", how="minimax")
    own = [
        solve_design(p, "E").criterion.loss(information_map(p).of_spectrum(worst.spectrum))
        for p in (plant, other)
    ]
    assert max(own) == pytest.approx(worst.loss, rel=1e-6)
    assert worst.loss >= max(solve_design(p, "E").loss for p in (plant, other)) * (1 - 1e-9)
    with pytest.raises(InputError, match="average of the criterion D"):
        robust_design([plant, other], "D", weights=[0.3, 0.7])


def test_minimax_d_against_a_general_optimiser(plant):
    """The certificate, the collapse to one plant, and a search over the weights of given lines."""
    assert robust_design([plant], "D", how="minimax").loss == pytest.approx(OPTIMA["D"], rel=1e-7)
    plants = [plant, plant.replace(den=[1, -0.8, 0.75])]
    worst = robust_design(plants, "D", how="minimax")
    assert abs(worst.gap) < 1e-7
    assert worst.certificate.check(points=4001) <= 1 + 1e-7
    maps = [information_map(p) for p in plants]
    loss = lambda M: np.exp(-np.linalg.slogdet(M)[1] / 4)
    own = [loss(m.of_spectrum(worst.spectrum)) for m in maps]
    assert max(own) == pytest.approx(worst.loss, rel=1e-9)
    # Equal to the larger optimum only if the other plant is no constraint.
    assert worst.loss >= max(solve_design(p, "D").bound for p in plants)
    # Twin: the lines found and others, their powers by a method that knows nothing of ours.
    lines = np.union1d(worst.spectrum.omega, [0.5, 0.8, 1.0, 1.2, 1.6])
    atoms = [np.stack([m.of_spectrum(Spectrum(np.array([w]), [1.0])) for w in lines]) for m in maps]
    share = lambda x: np.exp(x - x.max()) / np.exp(x - x.max()).sum()
    largest = lambda x: max(loss(np.einsum("k,kij->ij", share(x), A)) for A in atoms)
    found = minimize(largest, np.zeros(len(lines)), method="Powell", options={"maxiter": 60, "ftol": 1e-12})
    assert worst.bound * (1 - 1e-9) <= found.fun <= worst.loss * (1 + 1e-4)
    with pytest.raises(InputError, match="numbers must agree"):
        robust_design([plant, plant.replace(free=("b1", "b2"))], "D", how="minimax")


def test_a_small_unit_is_asked_for_like_a_large_one():
    """A parameter in a unit a million times larger was not asked for at all: its 1e-13 was taken for rounding of the other's 1."""
    required = np.diag([1.0, 1e-13])
    for known, loss in ((1e-16, 1e3), (1e-13, 1.0)):
        assert application_criterion(required).loss(np.diag([1.0, known])) == pytest.approx(loss)
    with pytest.raises(InputError, match="not zero"):
        application_criterion(np.zeros((2, 2)))


def test_least_power(plant):
    design = least_power_design(plant, "A", 0.1)
    assert design.loss == pytest.approx(0.1, rel=1e-8)
    assert design.spectrum.total_power == pytest.approx(OPTIMA["A"] / 0.1, rel=1e-8)
    required = np.diag([1.0, 2.0, 3.0, 4.0])
    enough = least_power_design(plant, application_criterion(required), 1.0)
    lowest = np.linalg.eigvalsh(enough.information - required)[0]
    assert lowest == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(InfeasibleDesign, match="no input is needed"):
        least_power_design(plant, "A", 10.0, prior=np.eye(4))


def _regression(powers: int) -> InformationMap:
    """Polynomial regression on [-1, 1] as a design problem: x = cos w."""
    rows = lambda omega: np.cos(omega)[:, None] ** np.arange(powers + 1)
    return InformationMap(
        tuple(f"c{k}" for k in range(powers + 1)),
        1,
        lambda omega: rows(omega)[:, :, None, None].astype(complex),
        lambda omega: np.ones((len(omega), 1, 1), dtype=complex),
        np.zeros((powers + 1,) * 2),
    )


def test_polynomial_regression():
    """D-optimal: P. G. Hoel (1958), equal weights at the zeros of (1 - x^2) P_n'(x).

    G-optimal: the same design (J. Kiefer, J. Wolfowitz, 1960), with the largest variance n + 1.
    Extrapolation to x = 2 from [-1, 1]: Hoel and Levine (1964), loss T_n(2)^2 at the Chebyshev points.
    """
    cubic = _regression(3)
    design = solve_design(cubic, "D")
    x = np.sort(np.cos(design.spectrum.omega))
    np.testing.assert_allclose(x, [-1, -np.sqrt(1 / 5), np.sqrt(1 / 5), 1], atol=1e-7)
    np.testing.assert_allclose(design.spectrum.power[:, 0, 0].real, 0.25, atol=1e-7)
    grid = np.cos(np.linspace(0, np.pi, 201))[:, None] ** np.arange(4)
    assert g_criterion(grid).loss(design.information) == pytest.approx(4.0, rel=1e-6)
    outside = solve_design(cubic, c_criterion(2.0 ** np.arange(4)))
    assert outside.loss == pytest.approx((4 * 8 - 3 * 2) ** 2, rel=1e-8)
    np.testing.assert_allclose(np.sort(np.cos(outside.spectrum.omega)), [-1, -0.5, 0.5, 1], atol=1e-6)


def test_g_optimality_of_quadratic_regression():
    grid = np.cos(np.linspace(0, np.pi, 41))[:, None] ** np.arange(3)
    design = solve_design(_regression(2), g_criterion(grid), tolerance=1e-5)
    assert design.loss == pytest.approx(3.0, rel=2e-5)
    assert design.gap <= 1e-5


def test_elfving_line():
    """Elfving (1952), straight line on [-1, 1]: the slope from both ends; the value at 0.5 with loss 1."""
    line = _regression(1)
    slope = solve_design(line, c_criterion([0.0, 1.0]))
    assert slope.loss == pytest.approx(1.0, rel=1e-8)
    inside = solve_design(line, c_criterion([1.0, 0.5]))
    assert inside.loss == pytest.approx(1.0, rel=1e-7)


def test_fir_models_want_white_input():
    """D-optimal for FIR with limited input power: any spectrum that is white up to n - 1 lags (Mehra, 1974)."""
    fir = named_plant("bandit-fir")
    white = Spectrum((np.arange(64) + 0.5) * np.pi / 64, np.full(64, 1 / 64))
    design = solve_design(fir, "D")
    assert design.loss == pytest.approx(1.0, rel=1e-6)
    assert design.efficiency(white) == pytest.approx(1.0, rel=1e-6)
    np.testing.assert_allclose(design.information, np.eye(fir.theta.size), atol=1e-3)


def test_directions_matter(rng):
    """Two inputs: equal white noise is beaten; the optimum is invariant to a rotation of the inputs."""
    gains = Plant([[[0, 1.0], [0, 0.5]]], [[[1.0], [1.0]]])
    design = solve_design(gains, d_criterion(2))
    assert design.loss == pytest.approx(2.0, rel=1e-8)  # powers 1/2 and 1/2, uncorrelated
    three = named_plant("three-by-two")
    design = solve_design(three, "A")
    assert design.gap < 1e-7
    assert design.efficiency_white < 1
