"""What the first experiments of finite length are worth together, zero initial states included.

In the eigenvectors v_i of the symmetric T G_N the mean of u u' stays diagonal: E u u' = N sum_i p_i v_i v_i', with
the mean shares p_i of `oed.theory.finite` (edges, and the fluctuation of mu to second order). The information of an experiment is linear
in u u', so its mean is N sum_i p_i F_i, with F_i the information of the signal v_i itself, from rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError
from oed.information import information_of_signal
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.efficiency import losses
from oed.theory.finite import random_mu

LARGEST = 2000


def finite_peak_gain_efficiency(plant: Plant, samples: int, experiments: int) -> NDArray[np.float64]:
    """c-efficiency of the first k experiments of Algorithm 1 together, from a white start, at finite N:
    returns (experiments,). Tends to `peak_gain_efficiency_by_experiments` ([S] Lemmas 6 and 13) as 1/N. The
    fluctuation of mu is counted where its expansion holds; with mu replaced by its mean everywhere the result
    is 10 % too high at N = 100. Twin: the mean information of simulated runs in the tests."""
    variance = float(np.trace(plant.noise_covariance))
    top = peak(plant)
    if plant.n_inputs * plant.n_outputs != 1 or not plant.white_noise or not variance > 0 or not top.unique:
        raise InputError(
            f"the plant {plant.name} has {plant.n_inputs} inputs, {plant.n_outputs} outputs and noise variance "
            f"{plant.noise_variance:g}; this theory needs one of each, white noise and a unique peak."
        )
    for name, value, least, most in (("samples", samples, 2, LARGEST), ("experiments", experiments, 1, 500)):
        if not isinstance(value, int | np.integer) or not least <= value <= most:
            raise InputError(f"{name} is {value!r}; it must be an integer from {least} to {most}.")
    g = plant.impulse_response(samples)[:, 0, 0]
    lag = np.subtract.outer(np.arange(samples), np.arange(samples))
    G = np.where(lag >= 0, g[np.maximum(lag, 0)], 0.0)
    d, V = np.linalg.eigh(G[::-1])
    F = np.array([information_of_signal(plant, v[:, None]) for v in V.T])
    c = gain_gradient(plant, top)
    shares = random_mu(d**2, variance, experiments)[2]
    total, efficiency = np.zeros(F.shape[1:]), np.zeros(experiments)
    for k in range(experiments):
        total = total + samples * np.tensordot(shares[k], F, 1)
        efficiency[k] = variance / ((k + 1) * samples * losses(total, c).c)
    return efficiency
