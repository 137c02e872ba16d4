"""Data in closed loop with a known controller: the reference is what may be chosen.

    u = r - C y,  y = G u + H e   =>   u = T r - T C H e,  T = (I + C G)^-1

Direct identification uses psi_i = H^-1 (dG_i u + dH_i e): the reference adds H^-1 dG_i T r, and what the noise brings
through the loop, H^-1 (dH_i - dG_i T C H) e, is information that is there whatever the reference."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.information_maps import InformationMap, information_map
from oed.errors import InputError
from oed.models.model import Model
from oed.plants.plant import Plant
from oed.plants.systems import as_plant
from oed.theory.quadrature import graded_edges, integral, panel_nodes, resolved_edges


def closed_loop_map(
    model: Plant | Model, controller: Callable[[NDArray[np.float64]], NDArray[np.complex128]]
) -> InformationMap:
    """Information map of the reference of a feedback loop.

    Parameters
    ----------
    model : Plant or Model
        The plant with its noise.
    controller : callable
        omega (K,) -> C (K, nu, ny), stable.

    Returns
    -------
    InformationMap
        Its input power is that of u that the reference causes; limits on outputs are those that it causes.

    Raises
    ------
    InputError
        If the loop is unstable (the locus of det(I + C G) encircles the origin).
    """
    model = model if isinstance(model, Model) else as_plant(model)
    open_loop = information_map(model)
    nu = open_loop.n_inputs

    def loop(omega: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        G, C = open_loop.gain(omega), np.asarray(controller(omega), dtype=complex)
        if C.shape != (len(omega), nu, G.shape[1]):
            raise InputError(
                f"the controller's response has the shape {C.shape}; it must be {(len(omega), nu, G.shape[1])}."
            )
        return G, C, np.linalg.inv(np.eye(nu) + C @ G)

    def det(omega: NDArray) -> NDArray[np.complex128]:
        G, C, _ = loop(omega)
        return np.linalg.det(np.eye(nu) + C @ G)

    # Resolved where it turns fast: between two nodes of its panels it turns by less than half.
    locus = lambda omega: np.column_stack([det(omega).real, det(omega).imag, 1 / np.abs(det(omega)) ** 2])
    edges = resolved_edges(locus, graded_edges(0.0, np.pi, open_loop.resonances), 1e-8)
    nodes = panel_nodes(edges[:-1], edges[1:])[0].ravel()
    turns = np.sum(np.diff(np.unwrap(np.angle(det(nodes)))))
    if abs(turns) > np.pi / 2:
        raise InputError(
            f"the closed loop is unstable: det(I + C G) turns by {turns / np.pi:.2g} half turns around 0; "
            "the design needs a controller that stabilises the plant."
        )
    L = np.linalg.cholesky(model.noise_covariance)

    def squares(omega: NDArray) -> NDArray[np.float64]:
        """What the noise itself excites: whitened dG_i T C H L, and dH_i L where H has parameters."""
        G, C, T = loop(omega)
        D = open_loop.factor(omega)
        if isinstance(model, Plant):
            H = model.noise_response(omega)[:, None, None] * np.eye(G.shape[1])
            own = np.zeros((len(omega), open_loop.n, *H.shape[1:]), dtype=complex)
        else:
            H, dH = model.noise_response(omega)
            white = np.linalg.inv(np.linalg.cholesky(model.noise_covariance))
            own = np.einsum("kpr,knrs->knps", white @ np.linalg.inv(H), dH)
        psi = (own - np.einsum("knpq,kqr->knpr", D, T @ C @ H)) @ L
        flat = psi.reshape(len(omega), open_loop.n, -1)
        return (flat @ flat.conj().swapaxes(1, 2)).real

    return InformationMap(
        names=open_loop.names,
        n_inputs=nu,
        factor=lambda omega: np.einsum("knpq,kqr->knpr", open_loop.factor(omega), loop(omega)[2]),
        gain=lambda omega: open_loop.gain(omega) @ loop(omega)[2],
        constant=integral(squares, edges, 1e-11) / np.pi,
        resonances=open_loop.resonances,
        input_gain=lambda omega: loop(omega)[2],
        dt=open_loop.dt,
    )
