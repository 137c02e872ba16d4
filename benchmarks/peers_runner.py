"""One record through one tool, in a process of its own: `python -P peers_runner.py PEER FILE.npz` prints one line of JSON.

It runs in the environment that `make peers` makes, where none of our packages is installed: numpy and the tool are all it
imports (our own, for the row `oed`, in ours). Signals are scaled to mean 0 and deviation 1 of the training record for every
tool but ours. A free run starts from the samples before `skip`, and the error counts those from there on."""

import importlib
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

LAGS = 10  # of output and input where a tool leaves them to its user (the first examples have 2, too few for a delay)
STATES, HIDDEN = 3, 5
"""Of the recurrent network; the tool's documentation has 5 hidden neurons and leaves the states open."""
NEEDS = {
    "sysidentpy": ("sysidentpy.model_structure_selection", "sysidentpy.basis_function"),
    "pysindy": ("pysindy",),
    "jax-sysid": ("jax", "jax_sysid.models"),
    "scikit-learn": ("sklearn.ensemble",),
    "sippy": ("sippy_unipi",),
    "oed": ("estimators.diagnosis.loop", "oed.data"),
}


class Split(NamedTuple):
    """Training and test signals (N, n), and how many test samples set the state."""

    u: Any
    y: Any
    u2: Any
    y2: Any
    skip: int


class Found(NamedTuple):
    """Free run over the test samples from `skip` on, number of parameters, and what was explained ("" for nothing)."""

    run: Any
    parameters: int | None
    explains: str


def lagged(y: Any, u: Any, k: int) -> Any:
    """The regressors of sample k: the outputs before it, the inputs up to it."""
    return np.r_[y[k - LAGS : k].ravel(), u[k - LAGS : k + 1].ravel()]


def scikit_learn(s: Split, ensemble: Any) -> Found:
    """Gradient boosting on hand-made lags, default settings."""
    X = np.array([lagged(s.y, s.u, k) for k in range(LAGS, len(s.y))])
    model = ensemble.HistGradientBoostingRegressor(random_state=0).fit(X, s.y[LAGS:, 0])
    run = s.y2.copy()
    run[s.skip :] = 0.0
    for k in range(s.skip, len(run)):
        run[k] = model.predict(lagged(run, s.u2, k)[None])[0]
    leaves = sum(int(tree.nodes["is_leaf"].sum()) for stage in model._predictors for tree in stage)
    return Found(run[s.skip :], leaves, "")


def sysidentpy(s: Split, selection: Any, basis: Any) -> Found:
    """FROLS with a polynomial of degree 2 and the number of terms by information criterion, as in the quick start."""
    model = selection.FROLS(
        order_selection=True, ylag=LAGS, xlag=LAGS if s.u.shape[1] == 1 else [list(range(1, LAGS + 1))] * s.u.shape[1],
        basis_function=basis.Polynomial(degree=2),
    )  # fmt: skip
    model.fit(X=s.u, y=s.y)
    run = model.predict(X=s.u2[s.skip - LAGS :], y=s.y2[s.skip - LAGS :])
    return Found(run[LAGS:], len(model.theta), f"equation of {len(model.theta)} terms")


def pysindy(s: Split, tool: Any) -> Found:
    """Discrete SINDy with its default library and optimiser; the state is the output and the output one sample before."""
    model = tool.DiscreteSINDy()
    model.fit(np.hstack((s.y[1:], s.y[:-1])), t=1, u=s.u[1:])
    start = np.r_[s.y2[s.skip - 1], s.y2[s.skip - 2]]
    run = model.simulate(start, len(s.y2) - s.skip + 1, u=s.u2[s.skip - 1 :])
    terms = int(np.count_nonzero(model.coefficients()))
    return Found(run[1:, :1], terms, f"equation of {terms} terms")


def jax_sysid(s: Split, jax: Any, models: Any) -> Found:
    """A residual recurrent network, 1000 steps of Adam and 1000 of L-BFGS: the documentation's settings."""
    nu, rng = s.u.shape[1], np.random.default_rng(0)
    shapes = {"B": (STATES, nu), "C": (1, STATES), "in": (HIDDEN, STATES + nu), "out": (STATES, HIDDEN)}
    shapes |= {"read": (HIDDEN, STATES), "write": (1, HIDDEN)}
    start = [0.5 * np.eye(STATES), *(0.3 * rng.standard_normal(shape) for shape in shapes.values())]
    start += [np.zeros(n) for n in (HIDDEN, STATES, HIDDEN, 1)]

    def state(x: Any, u: Any, params: Any) -> Any:
        p = params
        hidden = jax.nn.sigmoid(p[3] @ jax.numpy.concatenate((x, u)) + p[7])
        return p[0] @ x + p[1] @ u + p[4] @ hidden + p[8]

    def output(x: Any, u: Any, params: Any) -> Any:
        p = params
        return p[2] @ x + p[6] @ jax.nn.sigmoid(p[5] @ x + p[9]) + p[10]

    model = models.Model(STATES, 1, nu, state_fcn=jax.jit(state), output_fcn=jax.jit(output))
    model.init(params=start)
    model.loss(rho_x0=1e-4, rho_th=1e-4)
    model.optimization(adam_epochs=1000, lbfgs_epochs=1000, iprint=-1)
    model.fit(s.y, s.u)
    x0 = model.learn_x0(s.u2[: s.skip], s.y2[: s.skip])
    run, _ = model.predict(x0, s.u2)
    return Found(np.asarray(run)[s.skip :], sum(np.size(p) for p in start), "")


def sippy(s: Split, tool: Any) -> Found:
    """N4SID with the order, 1 to 10, by information criterion; the initial state by least squares on the first samples."""
    model = tool.system_identification(s.y.T, s.u.T, "N4SID", IC="AICc")
    A, B, C, D = (np.asarray(getattr(model, name)) for name in "ABCD")

    def run(x: Any, u: Any) -> Any:
        out = np.empty((len(u), 1))
        for k, now in enumerate(u):
            out[k], x = C @ x + D @ now, A @ x + B @ now
        return out

    zero = np.zeros((s.skip, s.u.shape[1]))
    free = np.hstack([run(e, zero) for e in np.eye(len(A))])
    forced = run(np.zeros(len(A)), s.u2[: s.skip])
    x0 = np.linalg.lstsq(free, s.y2[: s.skip] - forced, rcond=None)[0][:, 0]
    return Found(run(x0, s.u2)[s.skip :], A.size + B.size + C.size + D.size, "")


def size_of(answer: dict[str, Any]) -> int | None:
    """Parameters of our answer for one output; None where a remainder of memory stands on it, whose number is its own."""
    match answer["kind"]:
        case "linear":
            m = answer["model"]
            return len(m["den"]) - 1 + int(np.count_nonzero(m["num"])) + 1
        case "named":
            return len(answer["p"])
        case "discovered":
            return len(json.loads(answer["model"])["theta"])  # its model is a text of its own
    return None


def oed(s: Split, loop: Any, data: Any, clocks: Any) -> Found:
    """Our own, as `oed diagnose` runs it, told nothing."""
    (dt, t0), (_, t2) = clocks
    train, test = data.Record(s.u, s.y, dt=dt, t0=t0), data.Record(s.u2, s.y2, dt=dt, t0=t2)
    separate = bool(t2 < t0 + dt * (len(train) - 1))
    result = loop.diagnose(train, test, loop.Setting(skip=s.skip, separate=separate))
    sizes = [size_of(answer.to_dict()) for answer in result.model.answers]
    step = next((row["step"] for row in result.ladder if row["answer"]), "linear")
    said = {"named": f"cause: {result.effect}", "discovered": f"equation: {result.equation}"}.get(step, "")
    return Found(result.yhat_after[s.skip :], None if None in sizes else sum(filter(None, sizes)), said)


PEERS: dict[str, Callable[..., Found]] = {
    "sysidentpy": sysidentpy, "pysindy": pysindy, "jax-sysid": jax_sysid, "scikit-learn": scikit_learn, "sippy": sippy, "oed": oed,
}  # fmt: skip


def ran(peer: str, held: dict[str, Any]) -> dict[str, Any]:
    """The row of one record and one tool; CPU seconds of fit and simulation, without the imports."""
    s = Split(held["u"], held["y"], held["u2"], held["y2"], int(held["skip"]))
    modules = [importlib.import_module(name) for name in NEEDS[peer]]
    began = time.process_time()
    if peer == "oed":
        found, mean, spread = oed(s, modules[0], modules[1], held["clocks"].tolist()), 0.0, 1.0
    else:
        mean, spread, middle, width = s.y.mean(), s.y.std(), s.u.mean(axis=0), s.u.std(axis=0)
        u, u2, y, y2 = (
            (s.u - middle) / width,
            (s.u2 - middle) / width,
            (s.y - mean) / spread,
            (s.y2 - mean) / spread,
        )
        with np.errstate(all="ignore"):  # a free run that explodes is a row of the table
            found = PEERS[peer](Split(u, y, u2, y2, s.skip), *modules)
    cpu = time.process_time() - began
    error = (
        np.asarray(found.run, dtype=float).reshape(len(s.y2) - s.skip, -1) * spread + mean - s.y2[s.skip :]
    )
    with np.errstate(all="ignore"):
        rmse = float(np.sqrt(np.nanmean(error**2))) if np.isfinite(found.run).all() else float("inf")
    row = {
        "parameters": found.parameters,
        "cpu_s": cpu,
        "explains": bool(found.explains),
        "what": found.explains,
    }
    return row | (
        {"rmse": rmse, "reason": ""}
        if np.isfinite(rmse)
        else {"rmse": None, "reason": "its free run explodes"}
    )


def main() -> None:
    """The row as the last line of what is printed; tools print too."""
    with np.load(sys.argv[2]) as file:
        row = ran(sys.argv[1], dict(file))
    sys.stdout.write("\n" + json.dumps(row) + os.linesep)


if __name__ == "__main__":
    main()
