"""Running a recursion over a record: compiled where a C compiler is there, interpreted by CasADi where not.

Both ways fold the record in blocks of 500 samples, so that memory and the time to build do not depend on
its length and rounding errors do not grow with it. The compiled library is kept between processes.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shutil
import stat
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.pem.predictors.recursion import Recursion

__all__ = ["Kernel", "Sums", "compiler", "kernel_of", "library_folder"]

_BLOCK = 500
_DRIVER = """
/* What decays must not crawl through subnormal numbers, which cost a hundred times a normal operation. */
#ifdef __SSE2__
#include <xmmintrin.h>
#define FLUSH unsigned int mode = _mm_getcsr(); _mm_setcsr(mode | 0x8040);
#define RESTORE _mm_setcsr(mode);
#else
#define FLUSH
#define RESTORE
#endif
void fold(long long nr, const long long *length, const double *data, const double *p, const double *weight,
          double *total, double *work) {
#if NS + NT < 300  /* the compiler then keeps the state and the sums in registers where it can */
  double now[NS + 1], next[NS + 1], step[NT], block[NT];
#else
  double *now = work, *next = now + NS, *step = next + NS, *block = step + NT;
  work = block + NT;
#endif
  FLUSH
  for (long long r = 0; r < nr; ++r, total += NT, p += NP) {
    for (int i = 0; i < NS; ++i) now[i] = 0;
    for (long long start = 0; start < length[r]; start += BLOCK) {
      long long stop = start + BLOCK < length[r] ? start + BLOCK : length[r];
      for (int i = 0; i < NT; ++i) block[i] = 0;
      for (long long t = start; t < stop; ++t, data += ND) {
        const double *arg[4] = {now, data, p, weight};
        double *res[2] = {next, step};
        casadi_sums(arg, res, 0, work, 0);
        for (int i = 0; i < NT; ++i) block[i] += step[i];
        for (int i = 0; i < NS; ++i) now[i] = next[i];
      }
      for (int i = 0; i < NT; ++i) total[i] += block[i];
    }
  }
  RESTORE
}
void trace(long long n, long long ns, long long nd, long long ny, long long nj, const double *data,
           const double *p, double *state, double *e, double *jac, double *work) {
  double *now = state, *next = work;
  FLUSH
  for (long long t = 0; t < n; ++t) {
    const double *arg[3] = {now, data + t * nd, p};
    double *res[3] = {next, e + t * ny, jac ? jac + t * nj : 0};
    casadi_trace(arg, res, 0, work + ns, 0);
    double *swap = now; now = next; next = swap;
  }
  RESTORE
}
"""


@dataclass(frozen=True, eq=False)
class Sums:
    """What a pass over the records leaves behind, one row per record.

    `loss` (R,) sum e' W e; `gradient` (R, n) sum J' W e, half the gradient of the loss; `hessian` (R, n, n)
    sum J' W J; `covariance` (R, ny, ny) sum e e'; `log_variance` (R, 1 + n) sum of the log variances and its
    gradient; (R, 0) where they are constant.
    """

    loss: NDArray[np.float64]
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_variance: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kernel:
    """A recursion ready to run.

    `fold` (data (N, nd) of all records, lengths (R,), parameters (R, n), weight (ny, ny)) -> raw sums (R,
    nt); `trace` (data of one record, parameters, with_jacobian) -> residuals (N, ny), jacobian (N, ny, n) or
    None; `n, n_outputs` number of parameters and of outputs; `compiled` whether machine code runs.
    """

    fold: Callable[[NDArray, NDArray, NDArray, NDArray], NDArray]
    trace: Callable[[NDArray, NDArray, bool], tuple[NDArray, NDArray | None]]
    n: int
    n_outputs: int
    compiled: bool

    def sums(self, data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> Sums:
        """Loss, half gradient, Gauss-Newton matrix and residual covariance, each summed over each record.

        Shapes: data (N, nd), lengths (R,), parameters (R, n), weight (ny, ny).
        """
        raw, n, ny = self.fold(data, lengths, parameters, weight), self.n, self.n_outputs
        square = raw[:, 1 + n + _square(n)]
        at = 1 + n + n * (n + 1) // 2
        outer = raw[:, at + _square(ny)]
        return Sums(raw[:, 0], raw[:, 1 : 1 + n], square, outer, raw[:, at + ny * (ny + 1) // 2 :])


@lru_cache(maxsize=128)
def _square(n: int) -> NDArray[np.int64]:
    """(n, n) positions of a symmetric matrix within its lower triangle stored row by row."""
    i, j = np.indices((n, n))
    high, low = np.maximum(i, j), np.minimum(i, j)
    return high * (high + 1) // 2 + low


def compiler() -> str | None:
    """The C compiler that would be used: `OED_CC`, else cc, gcc or clang; None where there is none."""
    return _found(os.environ.get("OED_CC"), os.environ.get("PATH"))


@lru_cache(maxsize=8)
def _found(asked: str | None, path: str | None) -> str | None:
    del path  # part of the key only
    if asked is not None:
        return shutil.which(asked)
    return next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)


def library_folder() -> Path:
    """The folder of compiled libraries, which this user owns and only this user may write in.

    What is loaded from it runs: it is in the user's cache, else a new one that ends with the process, and never one
    of a known name in a folder that is shared.
    """
    base = os.environ.get("XDG_CACHE_HOME") or (
        os.environ.get("HOME", "") and os.path.join(os.environ["HOME"], ".cache")
    )
    folder = Path(base) / "oed-kernels"
    with contextlib.suppress(OSError):
        if base:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            found = folder.lstat()
            mine = os.name != "posix" or (found.st_uid == os.getuid() and not found.st_mode & 0o022)
            if mine and stat.S_ISDIR(found.st_mode) and os.access(folder, os.W_OK):
                return folder
    return Path(_own_folder().name)


@lru_cache(maxsize=1)
def _own_folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="oed-kernels-")


def _functions(recursion: Recursion) -> tuple[Any, Any, int]:
    """CasADi functions: (state, sample, p, weight) -> (state, sums), and (..) -> (state, e, J')."""
    import casadi as ca

    r, ny = recursion, recursion.residual.numel()
    n = r.parameters.numel()
    lower = ca.SX.sym("weight", ny * (ny + 1) // 2)
    weight = ca.SX(ny, ny)
    for k, (i, j) in enumerate(zip(*np.tril_indices(ny), strict=True)):
        weight[int(i), int(j)] = weight[int(j), int(i)] = lower[k]
    if ny == 1:
        weight = ca.SX(1)
    we, wj = weight @ r.residual, weight @ r.jacobian
    hessian, outer = r.jacobian.T @ wj, r.residual @ r.residual.T
    sums = [r.residual.T @ we, r.jacobian.T @ we]
    sums += [hessian[int(i), int(j)] for i, j in zip(*np.tril_indices(n), strict=True)]
    sums += [outer[int(i), int(j)] for i, j in zip(*np.tril_indices(ny), strict=True)]
    if r.log_variance is not None:
        sums += [r.log_variance, r.log_gradient.T]
    total = ca.densify(ca.vertcat(*sums))
    state = [r.state, r.sample, r.parameters]
    fold = ca.Function("sums", [*state, lower], [ca.densify(r.next_state), total], {"cse": True})
    trace = ca.Function(
        "trace", state, [ca.densify(r.next_state), r.residual, ca.densify(r.jacobian.T)], {"cse": True}
    )
    return fold, trace, n


def kernel_of(recursion: Recursion) -> Kernel:
    """Make a recursion ready to run, by compiling it if a compiler is there."""
    fold, trace, n = _functions(recursion)
    ny = recursion.residual.numel()
    tool = compiler()
    library = _compile(tool, fold, trace) if tool else None
    if library is None:
        return Kernel(_folded(fold), _traced(trace, n), n, ny, compiled=False)
    return Kernel(*_native(library, fold, n, ny, max(fold.sz_w(), trace.sz_w())), n, ny, compiled=True)


def _compile(tool: str, fold: Any, trace: Any) -> ctypes.CDLL | None:
    """The compiled library, from the cache or freshly made; None if the compiler fails."""
    import casadi as ca

    source = ""
    for function in (fold, trace):
        generator = ca.CodeGenerator("k.c", {"with_header": False, "verbose": False})
        generator.add(function)
        text = generator.dump()
        name = function.name()
        body = text[text.index("static int casadi_f0") : text.index("CASADI_SYMBOL_EXPORT int " + name)]
        helpers = "" if "casadi_sq" not in body else "static double casadi_sq(double x) { return x * x; }\n"
        source += ("" if helpers and "casadi_sq(double" in source else helpers) + body.replace(
            "casadi_f0", f"casadi_{name}"
        )
    source = (
        "#include <math.h>\n#define casadi_real double\n#define casadi_int double\n"
        f"#define BLOCK {_BLOCK}\n#define NS {fold.numel_out(0)}\n#define NT {fold.numel_out(1)}\n"
        f"#define ND {fold.numel_in(1)}\n#define NP {fold.numel_in(2)}\n{source}{_DRIVER}"
    )
    folder = library_folder()
    path = folder / f"pem-{hashlib.sha256((tool + source).encode()).hexdigest()[:24]}.so"
    if not path.exists():
        with tempfile.TemporaryDirectory(dir=folder) as work:
            code, built = Path(work) / "kernel.c", Path(work) / "kernel.so"
            code.write_text(source)
            command = [
                tool,
                "-O3",
                "-fPIC",
                "-shared",
                "-ffp-contract=off",
                "-o",
                str(built),
                str(code),
                "-lm",
            ]
            try:
                done = subprocess.run(command, capture_output=True, timeout=300, check=False)
            except (OSError, subprocess.TimeoutExpired):
                return None
            if done.returncode:
                return None
            os.replace(built, path)
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        return None


def _native(library: ctypes.CDLL, fold: Any, n: int, ny: int, n_work: int) -> tuple[Callable, Callable]:
    ns, nt = fold.numel_out(0), fold.numel_out(1)
    lower = np.tril_indices(ny)
    pointer = lambda a: a.__array_interface__["data"][0]
    library.fold.argtypes = [ctypes.c_longlong, *[ctypes.c_void_p] * 6]
    library.trace.argtypes = [*[ctypes.c_longlong] * 5, *[ctypes.c_void_p] * 6]

    def run_fold(data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> NDArray:
        total, work = np.zeros((len(lengths), nt)), np.empty(2 * ns + 2 * nt + n_work + 1)
        w, p = np.ascontiguousarray(weight[lower]), np.ascontiguousarray(parameters)
        library.fold(
            len(lengths), pointer(lengths), pointer(data), pointer(p), pointer(w), pointer(total), pointer(work)
        )  # fmt: skip
        return total

    def run_trace(data: NDArray, parameters: NDArray, with_jacobian: bool) -> tuple[NDArray, NDArray | None]:
        state, work, e = np.zeros(max(ns, 1)), np.empty(ns + n_work + 1), np.empty((len(data), ny))
        jacobian = np.empty((len(data), ny, n)) if with_jacobian else None
        library.trace(
            len(data), ns, data.shape[1], ny, ny * n, pointer(data), pointer(parameters),
            pointer(state), pointer(e), None if jacobian is None else pointer(jacobian), pointer(work),
        )  # fmt: skip
        return e, jacobian

    return run_fold, run_trace


def _folded(fold: Any) -> Callable[[NDArray, NDArray, NDArray, NDArray], NDArray]:
    """Sums by CasADi's virtual machine: the totals ride along with the state, block by block."""
    import casadi as ca

    s, x, p, w = (ca.SX.sym(a, fold.numel_in(k)) for k, a in enumerate(("s", "x", "p", "w")))
    total = ca.SX.sym("total", fold.numel_out(1))
    after, step = fold(s, x, p, w)
    ns = s.numel()
    one = ca.Function("one", [ca.vertcat(s, total), x, p, w], [ca.vertcat(after, total + step)])
    blocks = {1: one, 20: one.fold(20), _BLOCK: one.fold(_BLOCK)}
    lower = np.tril_indices(int((np.sqrt(8 * w.numel() + 1) - 1) / 2))

    def run(data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> NDArray:
        whole, at = np.zeros((len(lengths), total.numel())), 0
        for r, end in enumerate(np.cumsum(lengths)):
            carried = np.zeros(ns + total.numel())
            while at < end:
                carried[ns:] = 0.0
                stop = min(at + _BLOCK, end)
                while at < stop:
                    length = next(k for k in (_BLOCK, 20, 1) if k <= stop - at)
                    held = [_repeat(v, length) for v in (parameters[r], weight[lower])]
                    carried = np.array(blocks[length](carried, data[at : at + length].T, *held)).ravel()
                    at += length
                whole[r] += carried[ns:]
        return whole

    return run


def _repeat(values: NDArray, length: int) -> NDArray:
    return np.repeat(values[:, None], length, axis=1)


def _traced(trace: Any, n: int) -> Callable[[NDArray, NDArray, bool], tuple[NDArray, NDArray | None]]:
    blocks = {k: trace.mapaccum(f"trace{k}", k) if k > 1 else trace for k in (1, 20, _BLOCK)}
    ny = trace.numel_out(1)

    def run(data: NDArray, parameters: NDArray, with_jacobian: bool) -> tuple[NDArray, NDArray | None]:
        state, at = np.zeros(trace.numel_in(0)), 0
        e, jacobian = np.empty((len(data), ny)), np.empty((len(data), ny, n)) if with_jacobian else None
        while at < len(data):
            length = next(k for k in (_BLOCK, 20, 1) if k <= len(data) - at)
            states, part, sensitivity = blocks[length](
                state, data[at : at + length].T, _repeat(parameters, length)
            )
            state = np.array(states)[:, -1] if states.numel() else state
            e[at : at + length] = np.array(part).T
            if jacobian is not None:
                jacobian[at : at + length] = np.array(sensitivity).T.reshape(length, ny, n)
            at += length
        return e, jacobian

    return run
