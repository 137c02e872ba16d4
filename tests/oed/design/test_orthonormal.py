"""Orthonormal coordinates of a rational plant against the plant's own derivatives, its poles by differences, and exact fractions."""

from __future__ import annotations

from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest

from oed import solve_design
from oed.design.problem.orthonormal import (
    LARGEST,
    Orthonormal,
    _decimals,
    _inverse,
    orthonormal_coordinates,
)
from oed.errors import InputError
from oed.plants.plant import Plant
from tests.oracles.digits import pole_slope

OMEGA = np.linspace(0.01, 3.1, 400)
AT = np.array([0.2, 0.9, 2.5])
COVARIANCE = np.array([[0.5, 0.2], [0.2, 0.4]])


def several() -> Plant:
    """Two outputs, two inputs, a delay of three samples, an entry that is nothing, and noise with a memory."""
    num = [[[0.0, 0.5, 0.2], [0.0, 0.0, 0.0, 0.7]], [[0.0], [0.0, 0.3, -0.1, 0.2]]]
    den = [[[1.0, -1.2, 0.6], [1.0, -0.5]], [[1.0], [1.0, 0.3, 0.4]]]
    return Plant(num, den, noise_covariance=COVARIANCE, noise_num=[1.0, 0.4], noise_den=[1.0, -0.6])


def alike(order: int = 4) -> Plant:
    """Poles and zeros so near one another that the coefficients' effects are one in double precision."""
    poles = 0.995 * np.exp(1j * (0.5 + 2e-4 * np.arange(order)))
    den = np.poly(np.concatenate((poles, poles.conj()))).real
    return Plant(np.r_[0.0, 0.0, np.poly([0.9, 0.9001, -0.3])], den, noise_covariance=0.25)


def told(plant: Plant) -> Orthonormal:
    found = orthonormal_coordinates(plant, OMEGA)
    assert found is not None
    return found


@pytest.mark.parametrize("made", [several, alike])
def test_the_models_own_gradients_are_combinations_of_the_basis(made) -> None:
    plant, n = made(), len(made().free)
    base = told(plant)
    G, dG = base.response(AT)
    own = plant.response(AT)
    np.testing.assert_allclose(G, own[0], rtol=1e-11)
    T = base.times(np.eye(n), "T")
    np.testing.assert_allclose(
        np.einsum("ij,kjab->kiab", T, dG), own[1], rtol=1e-8, atol=1e-9 * np.abs(own[1]).max()
    )


@pytest.mark.parametrize("made", [several, alike])
def test_the_basis_is_orthonormal_where_the_noise_is_white(made) -> None:
    """On the grid, entry by entry, with the noise filter; not what the coefficients' own gradients are (the control)."""
    plant = made()
    base = told(plant)
    n, last = len(plant.free), 0
    H = plant.noise_response(OMEGA)
    gram = lambda dG: (
        np.einsum("kiab,kjab->ij", (dG / H[:, None, None, None]).conj(), dG / H[:, None, None, None]).real
    )
    np.testing.assert_allclose(gram(base.response(OMEGA)[1]) / len(OMEGA), np.eye(n), atol=1e-10)
    assert np.abs(gram(plant.response(OMEGA)[1]) / len(OMEGA) - np.eye(n)).max() > 0.1
    for entry in base.entries:
        assert (entry.at.start, entry.plant) == (last, plant)
        last = entry.at.stop
    assert last == n


def test_the_factor_whitens_the_noise_between_the_outputs() -> None:
    """Its products are the information of the response: with the inverse of the noise's covariance."""
    base = told(several())
    H = several().noise_response(AT)
    dG = base.response(AT)[1]
    found = base.factor(AT)
    assert found.shape == dG.shape
    for k in range(len(AT)):
        expected = (
            np.einsum("iaq,ab,jbr->iqjr", dG[k].conj(), np.linalg.inv(COVARIANCE), dG[k]) / abs(H[k]) ** 2
        )
        np.testing.assert_allclose(
            np.einsum("iaq,jar->iqjr", found[k].conj(), found[k]), expected, rtol=1e-11, atol=1e-13
        )


@pytest.mark.parametrize("made", [several, alike])
def test_the_ways_between_the_coordinates(made) -> None:
    base, n = told(made()), len(made().free)
    V = np.random.default_rng(0).normal(size=(n, 2))
    T, inverse, turned = (base.times(np.eye(n), which) for which in ("T", "inverse", "turned"))
    np.testing.assert_allclose(
        base.times(base.times(V, "inverse"), "T"), V, rtol=1e-3, atol=1e-6 * np.abs(inverse).max()
    )
    np.testing.assert_array_equal(turned, inverse.T)
    stack = np.stack([V, -2.0 * V])
    for which, M in (("T", T), ("inverse", inverse), ("turned", turned)):
        np.testing.assert_allclose(base.times(V, which), M @ V, rtol=1e-9, atol=1e-9 * np.abs(M).max())
        np.testing.assert_array_equal(
            base.times(stack, which), [base.times(V, which), -2.0 * base.times(V, which)]
        )
    for entry in base.entries:
        first, second, logdet = entry.exact
        m = len(first)
        with localcontext() as context:
            context.prec = 120
            assert max(abs(x) for x in (first @ second - _decimals(np.eye(m))).ravel()) < Decimal("1e-30")
        assert entry.times(np.eye(m), "T") == pytest.approx(first.astype(float), rel=1e-15)
        sign, value = np.linalg.slogdet(first.astype(float))
        if made is several:
            assert logdet == pytest.approx(value, rel=1e-12)
            assert sign
    if made is several:
        assert base.logdet == pytest.approx(np.linalg.slogdet(T)[1], rel=1e-12)


def test_the_determinant_of_what_double_precision_does_not_tell() -> None:
    """By exact fractions of the same decimals: 1e-90, and more, of what doubles would make of it."""
    (entry,) = told(alike()).entries
    T, _, logdet = entry.exact
    M, found = [[Fraction(x) for x in row] for row in T], Fraction(1)
    for k in range(len(M)):
        top = next(i for i in range(k, len(M)) if M[i][k])
        M[k], M[top] = M[top], M[k]
        found *= M[k][k]
        for i in range(k + 1, len(M)):
            M[i] = [a - M[i][k] / M[k][k] * b for a, b in zip(M[i], M[k], strict=True)]
    exact = abs(found)
    size = exact.numerator.bit_length() - exact.denominator.bit_length()
    assert logdet == pytest.approx(
        float(np.log(float(exact * Fraction(2) ** -size)) + size * np.log(2)), rel=1e-13
    )


@pytest.mark.parametrize("row, column", [(0, 0), (0, 1), (1, 1)])
def test_a_poles_slope_is_that_of_the_models_pole(row, column) -> None:
    plant, base = several(), told(several())
    p, h = np.roots(plant.den[row][column])[0], 1e-6

    def moved(i: int, by: float) -> complex:
        theta = plant.theta.copy()
        theta[i] += by
        roots = np.roots(plant.with_theta(theta).den[row][column])
        return roots[np.argmin(np.abs(roots - p))]

    own = np.array([(moved(i, h) - moved(i, -h)) / (2 * h) for i in range(len(plant.free))])
    found = base.slope_of_pole(row, column, p + 1e-5)
    T = base.times(np.eye(len(own)), "T")
    np.testing.assert_allclose(T @ found, own, atol=1e-8)
    assert np.abs(own).max() > 0.1
    np.testing.assert_array_equal(base.slope_of_pole(1, 0, p), 0.0)


def test_a_pole_gets_its_digits_from_those_of_its_eigenvalue() -> None:
    """Poles of a cluster are roots to five digits in double precision, and their slopes to four."""
    poles = np.array([0.9, 0.9001, 0.9002, 0.5])
    plant = Plant([0.0, 1.0], np.poly(poles))
    base = told(plant)
    T = base.times(np.eye(5), "T")
    for p in poles:
        found = T @ base.slope_of_pole(0, 0, p * (1 + 2e-7))
        np.testing.assert_allclose(found, pole_slope(plant, p).astype(float)[:, 0], rtol=1e-6, atol=1e-6)


def test_a_gradient_beside_alike_poles_has_its_digits() -> None:
    """The first of the basis is z^2 / A^2 but for a factor, and G is B / A: by exact fractions of the same z; in double precision 1e-6 is lost."""
    plant, base, omega = alike(), told(alike()), np.array([0.5])
    z = np.exp(-1j * omega.astype(np.longdouble))[0]
    exact = [Fraction(*part.as_integer_ratio()) for part in (z.real, z.imag)]

    def times(x: list[Fraction], y: list[Fraction]) -> list[Fraction]:
        return [x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]]

    def over(x: list[Fraction], y: list[Fraction]) -> complex:
        size = y[0] ** 2 + y[1] ** 2
        return complex(float((x[0] * y[0] + x[1] * y[1]) / size), float((x[1] * y[0] - x[0] * y[1]) / size))

    def value(polynomial: np.ndarray) -> list[Fraction]:
        found = [Fraction(0), Fraction(0)]
        for a in polynomial[::-1]:
            found = times(found, exact)
            found[0] += Fraction(float(a))
        return found

    A, B = value(plant.den[0][0]), value(plant.num[0][0])
    G, dG = base.response(omega)
    assert dG[0, 0, 0, 0] / base.entries[0].first == pytest.approx(
        over(times(exact, exact), times(A, A)), rel=1e-8
    )
    assert G[0, 0, 0] == pytest.approx(over(B, A), rel=1e-8)


def test_what_cancels_is_rounded_once() -> None:
    """The way there and back, of two coefficients, in more digits than it needs."""
    plant = Plant([0.0, 1.0], [1.0, -0.9999999])
    (entry,) = told(plant).entries
    V = entry.times(np.eye(2), "inverse")
    with localcontext() as context:
        context.prec = 200
        exact = (entry.exact[0] @ _decimals(V)).astype(float)
    np.testing.assert_array_equal(entry.times(V, "T"), exact)
    assert 0.0 < np.abs(exact - np.eye(2)).max() < 1e-6


def test_what_has_no_such_coordinates() -> None:
    plant = several()
    assert orthonormal_coordinates(plant.replace(free=plant.all_names[1:]), OMEGA) is None
    taps = lambda count: Plant(np.r_[0.0, np.ones(count)], [1.0])
    assert orthonormal_coordinates(taps(LARGEST), OMEGA) is not None
    assert orthonormal_coordinates(taps(LARGEST + 1), OMEGA) is None


def test_an_inverse_of_decimals_exchanges_rows() -> None:
    """A zero at the first place, and sizes apart by 1e40: elimination by the largest of a column, and no other."""
    S = np.array(
        [
            [Decimal(0), Decimal(2), Decimal(1)],
            [Decimal("1e-40"), Decimal(1), Decimal(3)],
            [Decimal(3), Decimal(0), Decimal(1)],
        ],
        dtype=object,
    )
    inverse, logdet = _inverse(S)
    product = S @ inverse
    assert max(abs(x) for x in (product - _decimals(np.eye(3))).ravel()) < Decimal("1e-25")
    # by the first row: -2 (1e-40 - 9) + 1 (0 - 3)
    assert float(logdet) == pytest.approx(np.log(15.0), rel=1e-12)
    assert _decimals(np.array([[0.1]]))[0, 0] == Decimal.from_float(0.1) != Decimal("0.1")


def test_more_coefficients_than_any_digits_are_found_for_are_refused_in_one_line() -> None:
    """The design of a plant of order 100 had not ended after nine minutes; one of as many FIR coefficients needs no such digits."""
    rng = np.random.default_rng(3)
    poles = 0.8 * np.exp(1j * np.linspace(0.1, 3.0, 31))
    den = np.poly(np.concatenate((poles, poles.conj()))).real
    with pytest.raises(InputError, match=r"124 coefficients .* more than 120 .* lower the order"):
        solve_design(Plant(np.r_[0.0, rng.standard_normal(62)], den))
