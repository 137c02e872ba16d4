"""Losses and their bounds, against textbook formulas and random matrices."""

from __future__ import annotations

import numpy as np
import pytest

from oed.criteria import (
    a_criterion,
    c_criterion,
    condition_criterion,
    d_criterion,
    e_criterion,
    g_criterion,
    worst_d_criterion,
)
from oed.errors import InputError


def _random_information(rng, n=4):
    B = rng.standard_normal((n, n + 2))
    return B @ B.T


def _all(rng, n=4):
    W = rng.standard_normal((n, 2))
    return [
        d_criterion(n),
        d_criterion(n, np.array([0, 2])),
        a_criterion(n),
        a_criterion(n, W @ W.T),
        c_criterion(rng.standard_normal(n)),
        e_criterion(n),
        e_criterion(n, np.array([1, 3])),
        g_criterion(rng.standard_normal((6, n))),
        g_criterion(rng.standard_normal((5, n, 2))),
        worst_d_criterion(rng.standard_normal((3, n, 2))),
    ]


def test_losses_are_the_textbook_formulas(rng):
    M = _random_information(rng)
    C = np.linalg.inv(M)
    c = rng.standard_normal(4)
    rows = rng.standard_normal((6, 4))
    W = np.diag([1.0, 2.0, 0.0, 3.0])
    assert d_criterion(4).loss(M) == pytest.approx(np.linalg.det(C) ** 0.25)
    assert d_criterion(4, np.array([0, 2])).loss(M) == pytest.approx(
        np.linalg.det(C[np.ix_([0, 2], [0, 2])]) ** 0.5
    )
    assert a_criterion(4).loss(M) == pytest.approx(np.trace(C))
    assert a_criterion(4, W).loss(M) == pytest.approx(np.trace(W @ C))
    assert c_criterion(c).loss(M) == pytest.approx(c @ C @ c)
    assert e_criterion(4).loss(M) == pytest.approx(np.linalg.eigvalsh(C)[-1])
    assert g_criterion(rows).loss(M) == pytest.approx(max(r @ C @ r for r in rows))
    pairs = rows.reshape(3, 2, 4).swapaxes(1, 2)
    assert worst_d_criterion(pairs).loss(M) == pytest.approx(
        max(np.sqrt(np.linalg.det(V.T @ C @ V)) for V in pairs)
    )


def test_the_bound_holds_for_every_direction_and_is_tight_at_its_own(rng):
    for criterion in _all(rng):
        M = _random_information(rng)
        loss = criterion.loss(M)
        X = criterion.direction(M)
        assert criterion.numerator(X) / np.trace(X.T @ M @ X) == pytest.approx(loss, rel=1e-9)
        for _ in range(40):
            Y = X + rng.standard_normal(X.shape) * rng.exponential()
            assert criterion.numerator(Y) / np.trace(Y.T @ M @ Y) <= loss * (1 + 1e-12)


def test_slopes_of_the_numerators_are_their_differences(rng):
    """Gradient and second derivatives of log numerator; of modified E's, of either trace, which is that of E."""
    for criterion in [*_all(rng), condition_criterion(4, [1.0, 2.0, 3.0, 4.0])]:
        X, step = rng.standard_normal((4, criterion.columns.shape[1])), 1e-6
        twin = e_criterion(4, criterion.V) if criterion.kind == "K" else criterion
        rise, bend = criterion.log_numerator(X)
        alone, none = criterion.log_numerator(X, False)
        np.testing.assert_array_equal(alone, rise)
        assert none is None
        for k in range(X.size):
            E = step * np.eye(X.size)[k].reshape(X.shape)
            slope = (np.log(twin.numerator(X + E)) - np.log(twin.numerator(X - E))) / (2 * step)
            assert rise.ravel()[k] == pytest.approx(slope, abs=1e-6 * np.abs(rise).max())
            bent = (twin.log_numerator(X + E)[0] - twin.log_numerator(X - E)[0]).ravel() / (2 * step)
            np.testing.assert_allclose(bend[k], bent, atol=1e-5 * np.abs(bend).max())


def test_conic_forms_have_the_loss_for_their_optimum(rng):
    """Two weights on two fixed informations: the programme's optimum is the least loss, on a fine grid of weights."""
    cp = pytest.importorskip("cvxpy")
    A, B = _random_information(rng), _random_information(rng)
    shares = np.linspace(0, 1, 2001)
    names = []
    for criterion in _all(rng):
        w = cp.Variable(nonneg=True)
        M = w * A + (1 - w) * B
        stated = criterion.conic(cp, M, criterion.V, criterion.columns @ criterion.columns.T)
        if stated is None:
            continue
        names.append(criterion.name)
        objective, limit = stated
        cp.Problem(objective, [w <= 1, *(() if limit is None else (limit,))]).solve(solver="CLARABEL")
        least = min(criterion.loss(s * A + (1 - s) * B) for s in shares)
        assert criterion.loss(float(w.value) * A + (1 - float(w.value)) * B) == pytest.approx(least, rel=1e-5)
    assert names == ["D", "A", "L", "c", "E", "E"]


def test_e_of_some_combinations(rng):
    V = rng.standard_normal((4, 2))
    M = _random_information(rng)
    told = np.linalg.eigvalsh(V.T @ np.linalg.inv(M) @ V)[-1]
    assert e_criterion(4, V).loss(M) == pytest.approx(told)
    assert e_criterion(4, np.array([1, 3])).loss(M) < e_criterion(4).loss(M)


def test_transformed_losses_are_the_same(rng):
    R = np.triu(rng.standard_normal((4, 4))) + 3 * np.eye(4)
    inverse = np.linalg.inv(R)
    for criterion in _all(rng):
        M = _random_information(rng)
        other, factor = criterion.transformed(R)
        assert factor * other.loss(inverse.T @ M @ inverse) == pytest.approx(criterion.loss(M), rel=1e-9)


def test_singular_information():
    M = np.diag([2.0, 0.0])
    assert c_criterion([1.0, 0.0]).loss(M) == pytest.approx(0.5)
    assert c_criterion([1.0, 1e-3]).loss(M) == np.inf
    assert d_criterion(2).loss(M) == np.inf


def test_bad_input_is_named():
    with pytest.raises(InputError, match="eigenvalue -1"):
        a_criterion(2, np.diag([1.0, -1.0]))
    with pytest.raises(InputError, match="symmetric 2 x 2"):
        a_criterion(2, np.eye(3))
    with pytest.raises(InputError, match="once"):
        d_criterion(3, np.array([0, 0]))
    with pytest.raises(InputError, match="nonzero"):
        c_criterion([0.0, 0.0])


def test_criteria_have_the_names_they_are_called_by(rng):
    V = rng.standard_normal((3, 4))
    plain = [
        d_criterion(4),
        a_criterion(4),
        a_criterion(4, np.eye(4)),
        c_criterion(V[0]),
        e_criterion(4),
        g_criterion(V),
    ]
    assert [c.name for c in plain] == ["D", "A", "L", "c", "E", "G"]
    assert worst_d_criterion(rng.standard_normal((3, 4, 2))).name == "W"
    assert condition_criterion(4).name == "modified-E"
    named = [
        d_criterion(4, name="x"),
        a_criterion(4, name="x"),
        a_criterion(4, np.eye(4), name="x"),
        c_criterion(V[0], name="x"),
    ]
    named += [e_criterion(4, name="x"), g_criterion(V, name="x"), condition_criterion(4, name="x")]
    named += [worst_d_criterion(rng.standard_normal((3, 4, 2)), name="x")]
    assert {c.name for c in named} == {"x"}


def test_the_condition_number_is_that_of_the_scaled_information(rng):
    M = _random_information(rng)
    lengths = np.array([1.0, 2.0, 0.5, 3.0])
    for unit, criterion in ((np.ones(4), condition_criterion(4)), (lengths, condition_criterion(4, lengths))):
        values = np.linalg.eigvalsh(M * np.outer(unit, unit))
        assert criterion.loss(M) == pytest.approx(values[-1] / values[0], rel=1e-10)
    for wrong in (np.ones(3), np.array([1.0, 0.0, 1.0, 1.0]), np.array([1.0, np.inf, 1.0, 1.0])):
        with pytest.raises(InputError):
            condition_criterion(4, wrong)


def test_whole_numbers_and_lists_will_do():
    M = [[2, 0], [0, 1]]
    losses = [
        c.loss(M)
        for c in (a_criterion(2, np.array([[1, 0], [0, 3]])), c_criterion([1, 2]), g_criterion([[1, 1]]))
    ]
    assert losses == pytest.approx([0.5 + 3, 0.5 + 4, 1.5])
    assert worst_d_criterion([[[1, 0], [0, 1]]]).loss(M) == pytest.approx(
        worst_d_criterion(np.eye(2)[None]).loss(np.array(M, float))
    )


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e6])
def test_a_weight_is_symmetric_to_rounding_of_its_own_size(size):
    off = np.array([[1.0, 1e-14], [0.0, 1.0]])
    assert a_criterion(2, size * off).loss(np.eye(2)) == pytest.approx(2 * size)
    for wrong in ([[1.0, 1e-8], [0.0, 1.0]], [[1.0, 0.5], [0.5 + 1e-8, 1.0]]):
        with pytest.raises(InputError, match="symmetric"):
            a_criterion(2, size * np.array(wrong))


def test_a_determinant_of_nothing_is_nothing():
    criterion = d_criterion(2)
    assert criterion.of_covariance(np.diag([1.0, -1e-20])) == 0.0
    assert criterion.of_covariance(np.diag([1.0, 0.0])) == 0.0
    assert criterion.numerator(np.ones((2, 2))) == 0.0
    assert criterion.scaled(np.array([[1.0, 0.0], [1.0, 0.0]]))[1] == 0.0


def test_the_scale_of_a_determinant_keeps_its_digits_of_a_triangle():
    """By QR it is off by a millionth."""
    criterion = d_criterion(2)
    assert criterion.scaled(np.array([[1.0, 0.0], [1e10, 1.0]]))[1] == 1.0
    assert criterion.scaled(np.array([[1.0, 2.0], [3.0, 4.0]]))[1] == pytest.approx(2.0, rel=1e-12)
    assert d_criterion(3, [0, 2]).name == "Ds"


def test_where_nothing_is_told_a_trace_rises_along_what_is_asked():
    rise, _ = a_criterion(2).log_numerator(np.diag([1.0, -1.0]))
    np.testing.assert_array_equal(rise, 2 * np.eye(2))


def test_a_condition_number_is_infinite_where_nothing_is_known_and_has_no_direction():
    criterion = condition_criterion(2, [1.0, 2.0])
    np.testing.assert_array_equal(criterion.V, np.diag([1.0, 0.5]))
    assert criterion.of_covariance(np.diag([2.0, 8.0])) == pytest.approx(4.0)
    for singular in (np.diag([0.0, 1.0]), np.diag([-1e-20, 1.0])):
        assert criterion.of_covariance(singular) == np.inf
    for asked in (
        lambda: criterion.numerator(np.eye(2)),
        lambda: criterion.turned(np.eye(2), np.eye(2), None),
    ):
        with pytest.raises(InputError, match="no bound by one direction"):
            asked()
    for size in (1e-6, 1e6):  # which it does not see
        other, factor = criterion.scaled(size * criterion.V)
        assert other.kind == "K"
        assert factor == 1.0
        np.testing.assert_allclose(other.V, criterion.of_unit_norm(criterion.V)[0].V, rtol=1e-12)
