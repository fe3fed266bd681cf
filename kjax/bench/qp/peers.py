"""Other people's QP solvers behind one call, (q, lower, upper) -> x; H is kept where it can be."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Solver = Callable[..., np.ndarray]


def box_peers(peers: dict[str, Any]) -> dict[str, Callable[[np.ndarray], Solver]]:
    """Per peer: from H to a call (q, lower, upper) -> x; what it may keep of H, it keeps."""
    made: dict[str, Callable[[np.ndarray], Solver]] = {}
    if "daqp" in peers:
        made["daqp, cold"] = daqp_cold
        made["daqp, warm"] = _daqp_warm
    if "quadprog" in peers:
        made["quadprog"] = _quadprog
    if "osqp" in peers:
        made["OSQP 1e-6"] = _osqp
    # ProxQP takes part with rows only: 0.8 ends the process on these boxes with equal bounds.
    if "piqp" in peers:
        made["PIQP"] = _piqp
    if "clarabel" in peers:
        made["Clarabel"] = _clarabel
    if "qpSWIFT" in peers:
        made["qpSWIFT"] = _qpswift
    if "qpax" in peers:
        made["qpax"] = _qpax
    return made


def daqp_cold(H: np.ndarray) -> Solver:
    """daqp, from nothing in every call."""
    import daqp

    n = len(H)
    none, sense = np.zeros((0, n)), np.zeros(n, np.int32)
    return lambda q, lower, upper: daqp.solve(H, q, none, upper, lower, sense)[0]


def _daqp_warm(H: np.ndarray) -> Solver:
    import daqp

    n, model = len(H), None

    def call(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        nonlocal model
        if model is None:
            model = daqp.Model()
            model.setup(H, q, np.zeros((0, n)), upper, lower, np.zeros(n, np.int32))
        else:
            model.update(f=q)
        return model.solve()[0]

    return call


def _quadprog(H: np.ndarray) -> Solver:
    import quadprog

    n = len(H)
    sides = np.hstack([np.eye(n), -np.eye(n)])

    def call(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        # Equal bounds as two inequalities it calls inconsistent; 1e-9 N between them it solves.
        apart = np.where(lower == upper, 1e-9, 0.0)
        return quadprog.solve_qp(H, -q, sides, np.r_[lower - apart, -upper])[0]

    return call


def _osqp(H: np.ndarray) -> Solver:
    import osqp
    from scipy import sparse

    n, model = len(H), None

    def call(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        nonlocal model
        if model is None:
            model = osqp.OSQP()
            model.setup(
                sparse.csc_matrix(np.triu(H)), q, sparse.eye(n, format="csc"), lower, upper,
                verbose=False, eps_abs=1e-6, eps_rel=1e-6,
            )  # fmt: skip
        else:
            model.update(q=q, l=lower, u=upper)
        return model.solve().x

    return call


def _piqp(H: np.ndarray) -> Solver:
    import piqp

    rows = np.eye(len(H))

    def call(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        model = piqp.DenseSolver()
        model.setup(H, q, None, None, rows, lower, upper)  # equal x_l, x_u it calls infeasible
        model.solve()
        return model.result.x

    return call


def _clarabel(H: np.ndarray) -> Solver:
    import clarabel
    from scipy import sparse

    n = len(H)
    P = sparse.csc_matrix(np.triu(H))
    A = sparse.vstack([sparse.eye(n), -sparse.eye(n)], format="csc")
    settings = clarabel.DefaultSettings()
    settings.verbose = False

    def call(q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        cones = [clarabel.NonnegativeConeT(2 * n)]
        model = clarabel.DefaultSolver(P, q, A, np.r_[upper, -lower], cones, settings)
        return np.asarray(model.solve().x)

    return call


def _qpswift(H: np.ndarray) -> Solver:
    import qpSWIFT

    G = np.vstack([np.eye(len(H)), -np.eye(len(H))])
    return lambda q, lower, upper: qpSWIFT.run(q, np.r_[upper, -lower], H, G)["sol"]


def _qpax(H: np.ndarray) -> Solver:
    import qpax

    n = len(H)
    solve = jax.jit(
        lambda q, lower, upper: qpax.solve_qp(
            jnp.asarray(H), q, jnp.zeros((0, n)), jnp.zeros(0),
            jnp.concatenate([jnp.eye(n), -jnp.eye(n)]), jnp.concatenate([upper, -lower]),
        )[0]
    )  # fmt: skip
    return lambda q, lower, upper: np.asarray(solve(q, lower, upper))
