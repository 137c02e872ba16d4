"""The refined instruments of `estimators.norm.local_fits`, compiled: sixty lines and twenty experiments are too few for NumPy.

The distances x are real, so with w = 1 / |A|^2 all products of powers of x over A are moments in x:

    V_p* diag(c) V_r = sum_k w x^(p + r) c,        T_j* (V_p S) = sum_k w x^(j + p) S,

T_j = x^j / A the transients. Every matrix of the normal equations is one of moments less one of their coordinates.
"""

import numpy as np
from numba import njit


@njit(error_model="numpy", cache=True)
def _planes(S):
    """(c, K, R) complex lines as (c, K, 2, R) real and imaginary parts, so that loops over the experiments vectorise."""
    found = np.empty((S.shape[0], S.shape[1], 2, S.shape[2]))
    for c in range(S.shape[0]):
        for k in range(S.shape[1]):
            for m in range(S.shape[2]):
                found[c, k, 0, m], found[c, k, 1, m] = S[c, k, m].real, S[c, k, m].imag
    return found


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, cache=True)
def _line_products(s, z, found):
    """Sums over the experiments of conj(s) z."""
    for k in range(s.shape[0]):
        real = imag = 0.0
        for m in range(s.shape[2]):
            real += s[k, 0, m] * z[k, 0, m] + s[k, 1, m] * z[k, 1, m]
            imag += s[k, 0, m] * z[k, 1, m] - s[k, 1, m] * z[k, 0, m]
        found[k] = complex(real, imag)


@njit(error_model="numpy", cache=True)
def _transients(A, powers, weights, inverse):
    """What the transients x^j / A need, by elimination in their Gram matrix, which is small and positive
    definite: A (K,), powers (D, K), weights, inverse (K,)."""
    t = inverse.shape[0]
    gram = np.zeros((t, t))
    for k in range(len(A)):
        weights[k] = 1 / (A[k].real ** 2 + A[k].imag ** 2)
        for i in range(t):
            for j in range(t):
                gram[i, j] += weights[k] * powers[i + j, k]
    for i in range(t):
        for j in range(t):
            inverse[i, j] = 1.0 if i == j else 0.0
    for i in range(t):
        pivot = gram[i, i]
        for j in range(t):
            gram[i, j] /= pivot
            inverse[i, j] /= pivot
        for k in range(t):
            if k != i:
                factor = gram[k, i]
                for j in range(t):
                    gram[k, j] -= factor * gram[i, j]
                    inverse[k, j] -= factor * inverse[i, j]


@njit(error_model="numpy", cache=True)
def _moments(weights, powers, c, found):
    """Sums over the lines of weights x^d c, for d from 0 on."""
    for d in range(len(powers)):
        real = imag = 0.0
        for k in range(len(c)):
            scale = weights[k] * powers[d, k]
            real += scale * c[k].real
            imag += scale * c[k].imag
        found[d] = complex(real, imag)


@njit(error_model="numpy", cache=True)
def _sums(S, weights, powers, inverse, sums, duals):
    """Moments of a channel in every experiment, and those from each degree on in the dual basis of the transients."""
    K, _, R = S.shape
    t = len(inverse)
    for d in range(sums.shape[0]):
        for part in range(2):
            for m in range(R):
                sums[d, part, m] = 0
        for k in range(K):
            scale = weights[k] * powers[d, k]
            for part in range(2):
                for m in range(R):
                    sums[d, part, m] += scale * S[k, part, m]
    for r in range(duals.shape[0]):
        for j in range(t):
            for part in range(2):
                for m in range(R):
                    duals[r, j, part, m] = 0
            for i in range(t):
                for part in range(2):
                    for m in range(R):
                        duals[r, j, part, m] += inverse[j, i] * sums[i + r, part, m]


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, cache=True)
def _products(moments, sums, duals, found):
    """The products of the powers p and r of two channels without transients."""
    for p in range(found.shape[0]):
        for r in range(found.shape[1]):
            real = imag = 0.0
            for j in range(duals.shape[1]):
                for m in range(duals.shape[3]):
                    real += sums[j + p, 0, m] * duals[r, j, 0, m] + sums[j + p, 1, m] * duals[r, j, 1, m]
                    imag += sums[j + p, 0, m] * duals[r, j, 1, m] - sums[j + p, 1, m] * duals[r, j, 0, m]
            found[p, r] = moments[p + r] - complex(real, imag)


@njit(error_model="numpy", cache=True)
def _normal_equations(
    U, Y, model, of_inputs, weights, powers, inverse, scale, orders, normal, information, right
):
    """The equations of one refinement: U, Y, model (nu, K, 2, R), of_inputs (nu, nu + ny, K), weights, powers
    (K,), inverse (nt + 1, nt + 1), scale (ny,), normal, information, right (n, n)."""
    nb, na, nt = orders
    nu, ny, K, R = U.shape[0], Y.shape[0], U.shape[1], U.shape[3]
    inner = nu * (nb + 1)
    first = ny * inner
    most = max(nb, na) + 1
    sums, duals = np.empty((nu + 2, nt + most, 2, R)), np.empty((nu + 2, most, nt + 1, 2, R))
    moments, lines, product = (
        np.empty(len(powers), right.dtype),
        np.empty(K, right.dtype),
        np.empty((most, most), right.dtype),
    )
    for j in range(nu):
        _sums(U[j], weights, powers, inverse, sums[j], duals[j])
    for i in range(ny):
        at, s = i * inner, scale[i]
        _sums(Y[i], weights, powers, inverse, sums[nu], duals[nu])
        _sums(model[i], weights, powers, inverse, sums[nu + 1], duals[nu + 1])
        for j in range(nu):
            for h in range(nu):
                _moments(weights, powers, of_inputs[j, h], moments)
                _products(moments, sums[j], duals[h], product)
                for p in range(nb + 1):
                    for r in range(nb + 1):
                        row, column = at + j * (nb + 1) + p, at + h * (nb + 1) + r
                        normal[row, column] = information[row, column] = s * product[p, r]
            _moments(weights, powers, of_inputs[j, nu + i], moments)
            _products(moments, sums[j], duals[nu], product)
            for p in range(nb + 1):
                row = at + j * (nb + 1) + p
                right[row] = s * product[p, 0]
                for r in range(na):
                    normal[row, first + r] = -s * product[p, r + 1]
            _line_products(model[i], U[j], lines)
            _moments(weights, powers, lines, moments)
            _products(moments, sums[nu + 1], duals[j], product)
            for p in range(nb + 1):
                row = at + j * (nb + 1) + p
                for r in range(na):
                    normal[first + r, row] = information[first + r, row] = -s * product[r + 1, p]
                    information[row, first + r] = -s * np.conj(product[r + 1, p])
        _line_products(model[i], Y[i], lines)
        _moments(weights, powers, lines, moments)
        _products(moments, sums[nu + 1], duals[nu], product)
        for p in range(na):
            right[first + p] -= s * product[p + 1, 0]
            for r in range(na):
                normal[first + p, first + r] += s * product[p + 1, r + 1]
        _line_products(model[i], model[i], lines)
        _moments(weights, powers, lines, moments)
        _products(moments, sums[nu + 1], duals[nu + 1], product)
        for p in range(na):
            for r in range(na):
                information[first + p, first + r] += s * product[p + 1, r + 1]


@njit(error_model="numpy", cache=True)
def _add(x, real, imag, z):
    """x += (real + j imag) z, both (2, R)."""
    for m in range(x.shape[1]):
        x[0, m] += real * z[0, m] - imag * z[1, m]
        x[1, m] += real * z[1, m] + imag * z[0, m]


@njit(error_model="numpy", cache=True)
def _left_over(U, Y, theta, A, powers, orders, inverse, errors, squares, model):
    """What the model and the transients leave of the outputs: U, Y (nu, K, 2, R), errors, squares, model (ny,
    K, 2, R)."""
    nb, _, nt = orders
    nu, ny, K, R = U.shape[0], Y.shape[0], U.shape[1], U.shape[3]
    along, total = np.empty((nt + 1, 2, R)), np.empty(R)
    for i in range(ny):
        for m in range(R):
            total[m] = 0
        for j in range(nt + 1):
            for m in range(R):
                along[j, 0, m] = along[j, 1, m] = 0
        for k in range(K):
            for m in range(R):
                errors[i, k, 0, m], errors[i, k, 1, m] = Y[i, k, 0, m], Y[i, k, 1, m]
            for j in range(nu):
                g = 0j
                for p in range(nb + 1):
                    g += theta[(i * nu + j) * (nb + 1) + p] * powers[p, k]
                g /= A[k]
                _add(errors[i, k], -g.real, -g.imag, U[j, k])
            for j in range(nt + 1):
                scale = powers[j, k] / np.conj(A[k])
                _add(along[j], scale.real, scale.imag, errors[i, k])
        for k in range(K):
            for h in range(nt + 1):
                scale = 0j
                for j in range(nt + 1):
                    scale += powers[j, k] * inverse[j, h]
                scale /= A[k]
                _add(errors[i, k], -scale.real, -scale.imag, along[h])
            for part in range(2):
                for m in range(R):
                    total[m] += errors[i, k, part, m] ** 2
                    model[i, k, part, m] = Y[i, k, part, m] - errors[i, k, part, m]
        squares[i] = total.sum()


@njit(error_model="numpy", cache=True)
def _solve(matrix, right):
    """Solve in place by elimination with row exchanges; False where a column has no pivot."""
    n = len(right)
    for c in range(n):
        best, at = 0.0, -1
        for r in range(c, n):
            size = abs(matrix[r, c])
            if size > best:
                best, at = size, r
        if at < 0:
            return False
        if at != c:
            for k in range(c, n):
                matrix[c, k], matrix[at, k] = matrix[at, k], matrix[c, k]
            right[c], right[at] = right[at], right[c]
        for r in range(c + 1, n):
            factor = matrix[r, c] / matrix[c, c]
            if factor != 0:
                for k in range(c + 1, n):
                    matrix[r, k] -= factor * matrix[c, k]
                right[r] -= factor * right[c]
    for c in range(n - 1, -1, -1):
        for k in range(c + 1, n):
            right[c] -= matrix[c, k] * right[k]
        right[c] /= matrix[c, c]
    return True


@njit(error_model="numpy", cache=True)
def refine(U, Y, powers, orders, floor, freedom, steps, settled, theta, information, noise):
    """Refined instruments until they settle: U, Y (nu, K, R), powers (D, K), floor, freedom (ny,), theta,
    information, noise (n,)."""
    nb, na, nt = orders
    nu, ny, K = U.shape[0], Y.shape[0], U.shape[1]
    n = ny * nu * (nb + 1) + na
    U, Y = _planes(U), _planes(Y)
    of_inputs = np.empty((nu, nu + ny, K), theta.dtype)
    for j in range(nu):
        for b in range(nu):
            _line_products(U[j], U[b], of_inputs[j, b])
        for b in range(ny):
            _line_products(U[j], Y[b], of_inputs[j, nu + b])
    a, A = np.zeros(na, theta.dtype), np.empty(K, theta.dtype)
    normal, scale, squares = np.empty((n, n), theta.dtype), np.empty(ny), np.empty(ny)
    weights, inverse = np.empty(K), np.empty((nt + 1, nt + 1))
    model, errors = Y.copy(), np.empty(Y.shape)
    for i in range(ny):
        scale[i] = 1.0
    for k in range(K):
        A[k] = 1
    _transients(A, powers, weights, inverse)
    for _ in range(steps):
        for r in range(n):  # loops, since whole arrays compile three times as long
            theta[r] = 0
            for c in range(n):
                normal[r, c] = information[r, c] = 0
        _normal_equations(
            U, Y, model, of_inputs, weights, powers, inverse, scale, orders, normal, information, theta
        )
        if not _solve(normal, theta):
            return False
        change = 0.0
        for r in range(na):
            change = max(change, abs(theta[n - na + r] - a[r]))
            a[r] = theta[n - na + r]
        for k in range(K):
            A[k] = 1
            for r in range(na):
                A[k] += a[r] * powers[r + 1, k]
        _transients(A, powers, weights, inverse)
        _left_over(U, Y, theta, A, powers, orders, inverse, errors, squares, model)
        for i in range(ny):
            noise[i] = max(squares[i] / freedom, floor[i])
            # the information has the scale of the step before
            change = max(change, abs(noise[i] * scale[i] - 1))
            scale[i] = 1 / noise[i]
        if change < settled:
            break
    return True


@njit(error_model="numpy", cache=True)
def responses(theta, x, orders, found):
    """G = B / A of the coefficients: theta (n,), x (K,), found (K, ny, nu)."""
    nb, na, _ = orders
    ny, nu = found.shape[1:]
    for k in range(len(x)):
        A = 0j
        for r in range(len(theta) - 1, len(theta) - na - 1, -1):
            A = (A + theta[r]) * x[k]
        A += 1
        for i in range(ny):
            for j in range(nu):
                first = (i * nu + j) * (nb + 1)
                B = 0j
                for p in range(nb, -1, -1):
                    B = B * x[k] + theta[first + p]
                found[k, i, j] = B / A
