"""What the final residual still shows: generic tests by nature, for causes that are in no catalogue."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2, f_oneway, kurtosis

from estimators.diagnosis.effects.effect import Nature
from estimators.diagnosis.model.fitting import Channel, Fit, ar_model, innovations
from estimators.diagnosis.model.layouts import LAYOUTS, states
from estimators.diagnosis.model.simulation import simulate
from estimators.residual.algebra import unit
from estimators.residual.measures import p_stated

Array = NDArray[Any]
LAGS = 40  # of the inputs: with 20, what rings longer than the linear model does left what looks bent
OWN = 20  # lags of the simulated output, which slow poles and feedback leave in a residual: a direction goes with them
TAKEN = 0.5  # share of a sample's variance that must be its own for its size to say anything of the noise's
TERMS = 6  # most products taken together


@dataclass(frozen=True)
class Leftover:
    """One thing that a residual still depends on.

    `nature` the kind of cause that would leave it; `sentence` the evidence; `p_value` corrected for the
    number of tests; `gain` likelihood ratio less Schwarz's price of its terms; 0 for the tests of the noise;
    `key` key of the catalogue where what is left has a name there, else empty.
    """

    nature: str
    sentence: str
    p_value: float
    gain: float
    key: str = ""


def _late(x: Array, by: int) -> Array:
    return np.concatenate((np.zeros(by), x[: len(x) - by])) if by else x


def _columns(channel: Channel, f: Fit, y: Array) -> list[tuple[str, str, list[Array]]]:
    """Groups of regressors: nature, what they are in words, the columns."""
    s = f.structure
    y0 = y - np.mean(y)
    v = np.gradient(y0)
    n = len(y)
    turn = 2 * np.pi * np.arange(n) / n
    t = np.linspace(-1.0, 1.0, n)
    groups: list[tuple[str, str, list[Array]]] = []
    for j in s.inputs:
        u = channel.u[:, j] - np.mean(channel.u[:, j])
        name = "the input" if len(s.inputs) == 1 else f"input {j + 1}"
        through = _through(f, j)
        curves = [through(c - np.mean(c)) for c in (u**2, u**3, u * np.abs(u), np.abs(u))]
        products = [u * _late(u, i) for i in range(1, 7)] + [u * _late(y0, i) for i in (0, 1, 2)] + [u * v]
        groups.append((Nature.LINEAR, f"past values of {name}", [_late(u, i) for i in range(1, LAGS + 1)]))
        groups.append((Nature.INPUT_STATIC, f"powers of {name} that act through the plant", curves))
        groups.append((Nature.DYNAMIC, f"products of {name} with its own past and with the output",
                       [through(c - np.mean(c)) for c in products]))  # fmt: skip
    groups.append((Nature.OUTPUT_STATIC, "powers of the simulated output",
                   [y0**2, y0**3, np.abs(y0), y0 * np.abs(y0), y0**4]))  # fmt: skip
    groups.append((Nature.DYNAMIC, "the simulated output's direction, speed and past, beyond proportion",
                   [np.sign(v), v * np.abs(v), v * y0, v * y0**2, v**2, v**3,
                    *[y0 * _late(y0, i) for i in (1, 2, 3, 4, 6, 8)]]))  # fmt: skip
    waves = [w(m * turn) * x for m in range(1, 7) for w in (np.cos, np.sin) for x in (y0, v)]
    groups.append(
        (Nature.TIME, "the simulated output in a way that changes with time", [t * y0, t * v, *waves])
    )
    groups.append((Nature.ADDED, "time: a trend or a change of level",
                   [np.ones(n), t, t**2, t**3, *[(t > a) * 1.0 for a in (-0.5, 0.0, 0.5)]]))  # fmt: skip
    return groups


def _through(f: Fit, j: int) -> Callable[[Array], Array]:
    """How what happens at an input acts on the output: through the linear part of the model, in a unit near its own size, since
    products of large signals would be taken for a run that explodes."""
    linear = _linear_part(f, j)
    return lambda x: linear(unit(x))


def _linear_part(f: Fit, j: int) -> Callable[[Array], Array]:
    s = f.structure
    if s.layout == "tf":
        den = np.concatenate(([1.0], f.p[: s.order]))
        at = s.order + s.inputs.index(j) * s.taps
        num = np.concatenate((np.zeros(1 + s.delay), f.p[at : at + s.taps]))
        return _filtered(num, den)
    if s.layout == "tanks":
        return lambda x: _late(x, 1)
    head = LAYOUTS[s.layout][1]
    C, only = f.p[head : head + s.order], np.eye(len(s.inputs))[s.inputs.index(j)]
    return lambda x: np.nan_to_num(states(s.layout, s.rates(f.p), np.outer(x, only)) @ C)


def _products(channel: Channel, f: Fit, y: Array) -> list[Array]:
    """Products of the input with past inputs and outputs, and with squares of outputs, through the plant."""
    y0 = y - np.mean(y)
    out: list[Array] = []
    lags = (0, 1, 2, 3, 4, 6)
    for j in f.structure.inputs:
        u = channel.u[:, j] - np.mean(channel.u[:, j])
        through = _through(f, j)
        past = {i: (_late(u, i), _late(y0, i)) for i in lags}
        terms = [past[a][0] * past[b][0] for a in lags for b in lags if a < b]
        terms += [past[a][0] * past[b][1] for a in lags for b in lags]
        terms += [past[a][0] * past[b][1] ** 2 for a in (0, 1, 3) for b in (0, 2, 4)]
        terms += [past[a][0] ** 2 * past[b][1] for a in (0, 1, 3) for b in (0, 2, 4)]
        out += [through(x - np.mean(x)) for x in terms]
    return out


def _best_products(
    channel: Channel, f: Fit, y: Array, J: Array, null: float
) -> tuple[float, float, int, float]:
    """(likelihood ratio, Schwarz's price, terms, products tried) of the few products that explain most, one taken after another."""
    keep, n = channel.keep, int(channel.keep.sum())
    X = np.stack([np.where(keep, x / (float(np.sqrt(np.mean(x**2))) + 1e-300), 0.0)
                  for x in map(unit, _products(channel, f, y))], axis=1)  # fmt: skip
    best = (0.0, 0.0, 0)
    for noise in [f.noise, np.zeros(0)][: 1 + bool(len(f.noise))]:
        W = np.stack([innovations(x, noise) for x in X.T], axis=1)
        e = innovations(np.where(keep, f.residual, 0.0), noise)
        Q = np.linalg.qr(np.stack([innovations(x, noise) for x in J.T], axis=1))[0] if J.size else J
        taken: list[int] = []
        for count in range(1, TERMS + 1):
            W, e = W - Q @ (Q.T @ W), e - Q @ (Q.T @ e)
            power = np.sum(W**2, axis=0)
            score = np.where(power > 1e-6 * n, (W.T @ e) ** 2 / np.maximum(power, 1e-300), 0.0)
            taken.append(int(np.argmax(score)))
            column = W[:, taken[-1]]
            Q = (column / (float(np.linalg.norm(column)) + 1e-300))[:, None]
            if count in (1, 3, TERMS):
                ratio = null - _deviance(f.residual, np.concatenate((J, X[:, taken]), axis=1), f.noise, keep)
                price = count * float(np.log(n) + 2.0 * np.log(X.shape[1]))
                if ratio - price > best[0] - best[1]:
                    best = (ratio, price, count)
    return best[0], best[1], best[2], float(X.shape[1])


def _sized(columns: list[Array], keep: NDArray[np.bool_]) -> Array:
    """Columns of unit size, zero where a sample does not count."""
    X = np.stack([c / (float(np.sqrt(np.mean(c**2))) + 1e-300) for c in map(unit, columns)], axis=1)
    return np.where(keep[:, None], X, 0.0)


def _filtered(num: Array, den: Array) -> Callable[[Array], Array]:
    return lambda x: np.asarray(lfilter(num, den, x))


def _sensitivity(channel: Channel, f: Fit, y: Array) -> Array:
    """Derivatives of the simulated output by the model's parameters, (N, size)."""
    J = np.zeros((len(y), len(f.p)))
    for i in range(len(f.p)):
        q, step = f.p.copy(), 1e-6 * f.scales[i]
        if step == 0.0:  # a parameter that is held
            continue
        q[i] += step
        moved = simulate(f.structure, q, channel.u, channel.clock)
        if np.all(np.isfinite(moved)):
            J[:, i] = (moved - y) / step
    return J[:, np.any(J != 0, axis=0)]


def _deviance(r: Array, X: Array, noise: Array, keep: NDArray[np.bool_]) -> float:
    """n log(innovation variance) + price of the noise model, X fitted out, the noise model chosen again."""
    n = int(keep.sum())
    best = np.inf
    for start in (noise, np.zeros(0)):
        again = start
        for _ in range(2):
            W = np.stack([innovations(c, again) for c in X.T], axis=1)
            size = np.maximum(np.abs(W).max(axis=0, initial=0.0), 1e-150)  # their squares may be no numbers
            size = size * np.maximum(np.sqrt(np.sum((W / size) ** 2, axis=0)), 1e-150)
            beta = np.linalg.lstsq(W / size, innovations(r, again), rcond=1e-9)[0] / size
            rest = r - X @ beta
            again, value = ar_model(np.where(keep, rest, 0.0))
            best = min(best, value + len(again) * float(np.log(n)))
    return best


def leftovers(channel: Channel, f: Fit, *, alpha: float = 0.01) -> list[Leftover]:
    """What a fitted model's innovations still depend on, the most telling first.

    Each group of regressors is a likelihood-ratio test with the noise model chosen again, with and without
    it: a noise model may have been fitted to what the model lacks. A line in the spectrum is Fisher's test;
    the noise is tested for a change of its size and for its tails. Bonferroni over all of them.
    """
    if channel.step > 0 or not np.all(np.isfinite(f.residual)):
        return []
    keep = channel.keep
    y = simulate(f.structure, f.p, channel.u, channel.clock)
    n = int(keep.sum())
    r = np.where(keep, f.residual, 0.0)
    out: list[Leftover] = []
    if not np.all(np.isfinite(y)) or float(r @ r) <= 1e-24 * float(channel.y @ channel.y):
        return out
    J = np.where(keep[:, None], _sensitivity(channel, f, y), 0.0)
    groups = _columns(channel, f, y)
    tests = len(groups) + 4
    plain, null = J, _deviance(r, J, f.noise, keep)
    lags = [c for nature, _, columns in groups if nature == Nature.LINEAR for c in columns]
    lags += [_late(y, i) for i in range(OWN)] + [np.gradient(y)]
    J = np.concatenate(
        (J, _sized(lags, keep)), axis=1
    )  # a model that is not the best linear one leaves what looks bent
    beyond = _deviance(r, J, f.noise, keep)
    if n > 20 * TERMS:
        ratio, price, count, tries = _best_products(channel, f, y, J, beyond)
        p = min(1.0, tests * tries**count * float(chi2.sf(max(ratio, 0.0), max(count, 1))))
        if count and p < alpha:
            share = 1.0 - float(np.exp(-ratio / n))
            out.append(Leftover(Nature.DYNAMIC, f"the residual still depends on products of past inputs and outputs "
                                f"({100 * share:.3g} % of its variance, {p_stated(p)})", p, ratio - price))  # fmt: skip
    for nature, words, columns in groups:
        linear = nature == Nature.LINEAR
        X = np.concatenate((plain if linear else J, _sized(columns, keep)), axis=1)
        ratio = (null if linear else beyond) - _deviance(r, X, f.noise, keep)
        p = min(1.0, tests * float(chi2.sf(max(ratio, 0.0), len(columns))))
        if p < alpha:
            share = 1.0 - float(np.exp(-ratio / n))
            out.append(Leftover(nature, f"the residual still depends on {words} ({100 * share:.3g} % of its "
                                f"variance, {p_stated(p)})", p, ratio - len(columns) * float(np.log(n))))  # fmt: skip
    e = innovations(r, f.noise)
    Q = (
        np.linalg.qr(np.stack([innovations(c, f.noise) for c in J.T], axis=1))[0]
        if J.size
        else np.zeros((len(e), 0))
    )
    own = 1.0 - np.sum(
        Q**2, axis=1
    )  # of a sample's variance: lags begin with nothing, and take the first samples whole
    e0 = e - Q @ (Q.T @ e)
    power = np.abs(np.fft.rfft(e0 - e0.mean()))[1:-1] ** 2
    line = float(power.max() / power.mean())
    p = min(1.0, tests * len(power) * float(np.exp(-line)))
    if p < alpha:
        at = (1 + int(np.argmax(power))) / len(e0)
        words = f"the residual has a line at {at:.4g} cycles per sample ({p_stated(p)})"
        out.append(Leftover(Nature.ADDED, words, p, 2.0 * line - 3.0 * float(np.log(n))))
    kept = (e0 / np.sqrt(np.maximum(own, TAKEN)))[keep & (own > TAKEN)]
    p = min(1.0, tests * float(f_oneway(*np.array_split(np.abs(kept), 8)).pvalue))
    if p < alpha:
        out.append(Leftover(Nature.NOISE, f"the noise changes its size in time ({p_stated(p)})", p, 0.0))
    tails = float(kurtosis(kept)) * np.sqrt(n / 24.0)
    p = min(1.0, tests * 2.0 * float(chi2.sf(max(tails, 0.0) ** 2, 1)))
    if tails > 0 and p < alpha * 1e-2:  # the normal limit of a kurtosis is slow
        out.append(Leftover(Nature.NOISE, f"the noise has heavy tails ({p_stated(p)})", p, 0.0, "outliers"))
    return sorted(out, key=lambda x: -x.gain)
