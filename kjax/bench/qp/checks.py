"""What the QP solvers must not get wrong, counted: gradients, random problems, public problems.

The judges here are plain NumPy and finite differences; nothing of ``kjax.qp`` judges itself.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from kjax import qp
from kjax.bench.timing import Call, median_us

TOLERANCE = 1e-9
SIZES = (4, 8, 16, 24, 40, 60)
TICKS = 64  # problems of a sequence, each warm-started by the one before
BATCH = 128  # sequences side by side
WEAK = 1e-4  # margin under which a bound counts as weakly active
_median_us = partial(median_us, indices=range(40), warm_up=1)


# ---------------------------------------------------------------- gradients


def gradients(log: dict[str, Any], count: int) -> dict[str, Any]:
    """Derivative of the point along random directions of q and of the bounds, against differences.

    Central differences over 1e-4 of the data's size are exact but for rounding, as the point is
    piecewise linear: 1e-10 relative. Only where no bound is weakly active on the way.
    """
    rng = np.random.default_rng(0)
    prepared, n = log["prepared"], log["q"].shape[1]

    def point(q: Any, lower: Any, upper: Any, mode: Any) -> Any:
        solution = qp.solve(prepared, q, lower, upper, index=mode)
        return solution.x, solution.margin

    @jax.jit
    def slope(data: Any, direction: Any, mode: Any) -> Any:
        def x_of(q: Any, lower: Any, upper: Any) -> Any:
            return point(q, lower, upper, mode)[0]

        pulled = jax.vjp(x_of, *data)[1]
        weight = jnp.arange(1.0, n + 1.0)
        backward = sum((a * b).sum() for a, b in zip(pulled(weight), direction, strict=True))
        return jax.jvp(x_of, data, direction)[1], backward, weight

    call = jax.jit(point)
    forward_errors, reverse_errors, left_out = [], [], 0
    for i in rng.choice(len(log["q"]), min(count, len(log["q"])), replace=False):
        data = tuple(log[k][i] for k in ("q", "lower", "upper"))
        mode = log["mode"][i]
        loose = data[2] > data[1]  # a fixed variable's bounds move together, or not at all
        sizes = (np.abs(data[0]).max(), *([np.abs(data[2]).max()] * 2))
        move = tuple(size * rng.normal(size=n) for size in sizes)
        move = (move[0], np.where(loose, move[1], 0.0), np.where(loose, move[2], 0.0))
        step = 1e-4
        ahead, behind = (
            call(*(a + s * step * b for a, b in zip(data, move, strict=True)), mode)
            for s in (1.0, -1.0)
        )
        here = call(*data, mode)
        near = 10 * step
        if min(float(m) for _, m in (ahead, behind, here)) < near * WEAK / 1e-3:
            left_out += 1
            continue
        wanted = np.asarray(ahead[0] - behind[0]) / (2 * step)
        forward, backward, weight = slope(data, move, mode)
        size = max(np.abs(wanted).max(), 1e-12)
        error = np.abs(np.asarray(forward) - wanted).max() / size
        # The segment may still cross a change of the active set that both ends do not show.
        forward_errors.append(error)
        reverse_errors.append(
            abs(float(backward) - float(weight @ wanted)) / (np.abs(weight).sum() * size)
        )
    errors = np.maximum(forward_errors, reverse_errors)
    return {
        "problems": len(errors),
        "weakly_active_left_out": left_out,
        "median": float(np.median(errors)),
        "max": float(np.max(errors)),
    }


# ---------------------------------------------------------------- random problems


def random_solves(total: int) -> dict[str, Any]:
    """Warm-started sequences of random boxes; every point that is called solved is re-checked."""
    rng = np.random.default_rng(1)
    count = {"solves": 0, "wrong_solved": 0, "iteration_limit": 0, "other_status": 0}
    worst = 0.0
    rounds = max(1, round(total / (len(SIZES) * BATCH * TICKS)))
    for n in tqdm(SIZES, desc="random problems", unit="size", leave=False, disable=None):
        solve = jax.jit(jax.vmap(_sequence))
        for _ in range(rounds):
            H, q, lower, upper = _draw(rng, n)
            x, status = map(np.asarray, solve(H, q, lower, upper))
            residual = independent_residual(H[:, None], q, lower, upper, x)
            solved = status == qp.Status.SOLVED
            # A tenth of the tolerance for what scaling x to its unit and back has rounded.
            fine = residual <= 1.1 * TOLERANCE
            count["solves"] += status.size
            count["wrong_solved"] += int((solved & ~fine).sum())
            count["iteration_limit"] += int((status == qp.Status.ITERATION_LIMIT).sum())
            count["other_status"] += int((status > qp.Status.ITERATION_LIMIT).sum())
            worst = max(worst, float(residual[solved].max(initial=0.0)))
    return {**count, "residual_max_of_solved": worst}


def _sequence(H: Any, q: Any, lower: Any, upper: Any) -> Any:
    prepared = qp.prepare(H)

    def tick(warm: Any, row: Any) -> Any:
        q, lower, upper = row
        solution = qp.solve(prepared, q, lower, upper, warm, tolerance=TOLERANCE)
        return solution.warm, (solution.x, solution.status)

    return jax.lax.scan(tick, qp.start(prepared), (q, lower, upper))[1]


def _draw(rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    """H (B, n, n), and q, lower, upper (B, T, n) as random walks; all scales are drawn too."""
    shape = (BATCH, TICKS, n)
    basis = np.linalg.qr(rng.normal(size=(BATCH, n, n)))[0]
    condition = 10.0 ** rng.uniform(0, 8, (BATCH, 1))
    spectrum = condition ** -np.linspace(0, 1, n)
    H = np.einsum("bij,bj,bkj->bik", basis, spectrum, basis)
    H = 0.5 * (H + H.transpose(0, 2, 1))
    steps = rng.normal(size=shape) * np.where(np.arange(TICKS) > 0, 0.3, 1.0)[:, None]
    pull = np.cumsum(steps, axis=1)
    # Part of the q pull along stiff directions, part along soft ones: 0 to all bounds active.
    q = np.where(rng.random((BATCH, 1, 1)) < 0.5, pull, np.einsum("bij,btj->bti", H, pull))
    width = 10.0 ** rng.uniform(-3, 2, (BATCH, 1, 1)) * rng.random(shape)
    middle = rng.normal(size=(BATCH, 1, n)) * width
    kind = rng.random(shape) if rng.random() < 0.5 else rng.random((BATCH, 1, n))
    lower = np.where(kind < 0.2, -np.inf, middle - width)
    upper = np.where((kind > 0.1) & (kind < 0.3), np.inf, middle + width)
    fixed = kind > 0.9
    lower, upper = np.where(fixed, middle, lower), np.where(fixed, middle, upper)
    unit = 2.0 ** rng.integers(-20, 21, (BATCH, 1, n))  # of each variable
    cost = 10.0 ** rng.uniform(-8, 8, (BATCH, 1, 1))  # of the objective
    H = H * cost * unit * unit.transpose(0, 2, 1)
    return H, q * cost * unit, lower / unit, upper / unit


def independent_residual(
    H: np.ndarray, q: np.ndarray, lower: np.ndarray, upper: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """Relative KKT residual in scaled coordinates, as a median of three; infinite outside the box.

    For l <= x <= u: the median of (x - u, gradient, x - l) is zero exactly at the minimiser.
    """
    d = np.diagonal(H, axis1=-2, axis2=-1) ** -0.5
    gradient = d * (np.einsum("...ij,...j->...i", H, x) + q)
    residual = np.median(np.stack([(x - upper) / d, gradient, (x - lower) / d]), axis=0)
    size = np.maximum(np.abs(d * q).max(-1), np.abs(x / d).max(-1))
    inside = ((lower <= x) & (x <= upper)).all(-1) & np.isfinite(x).all(-1)
    return np.where(inside, np.abs(residual).max(-1) / np.where(size > 0, size, 1.0), np.inf)


# ---------------------------------------------------------------- public problems


def public_problems(folder: Path, peers: dict[str, Any]) -> dict[str, Any]:
    """Problems P, q, G, h, A, b, lb, ub in ``*.npz``: solved to 1e-9, and time beside daqp [us].

    Those whose rows are all bounds go to the box solver, P prepared beforehand, the others to
    ``solve_rows``. Primal and dual residual and duality gap are absolute, as the public set has it,
    so the relative tolerance is set further down.
    """
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise FileNotFoundError(f"no .npz file in {folder}")
    prepare, residuals, ours, theirs = jax.jit(qp.prepare), [], [], []
    for file in tqdm(files, desc="public problems", leave=False, disable=None):
        with np.load(file, allow_pickle=True) as read:
            P, q, C, low, high, lower, upper = _as_rows(dict(read))
        if len(C):
            solve = jax.jit(
                partial(qp.solve_rows, method="active_set", tolerance=1e-14, max_iterations=1000)
            )
            arguments: tuple[Any, ...] = (P, q, C, low, high, lower, upper)
        else:
            solve = jax.jit(partial(qp.solve, prepare(P), tolerance=1e-14))
            arguments = (q, lower, upper)
        solution = solve(*arguments)
        x, y = np.asarray(solution.x), np.asarray(solution.multipliers)
        error = _gap(P, q, C, np.r_[low, lower], np.r_[high, upper], x, y)
        residuals.append(error)
        ours.append(_median_us(_x_of(solve, arguments)))
        if "daqp" in peers:
            theirs.append(_median_us(_by_daqp(P, q, C, low, high, lower, upper)))
    ratio = np.divide(ours, theirs) if theirs else np.array([np.nan])
    return {
        "problems": len(files),
        "solved_1e9": int(sum(max(e) <= TOLERANCE for e in residuals)),
        "largest_residual": float(np.max(residuals)),
        "us_median": float(np.median(ours)),
        "over_daqp_median": float(np.median(ratio)),
        "over_daqp_max": float(np.max(ratio)),
    }


def _x_of(solve: Callable[..., Any], arguments: tuple[Any, ...]) -> Call:
    return lambda _: np.asarray(solve(*arguments).x)


def _as_rows(read: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    """P, q, rows, their bounds, the box; rows of one entry become bounds."""
    P, q = read["P"], read["q"]
    n = len(q)
    given = {k: v for k, v in read.items() if v.shape != ()}
    lower = np.array(given.get("lb", np.full(n, -np.inf)), float)
    upper = np.array(given.get("ub", np.full(n, np.inf)), float)
    G, h = given.get("G", np.zeros((0, n))), given.get("h", np.zeros(0))
    A, b = given.get("A", np.zeros((0, n))), given.get("b", np.zeros(0))
    single = (G != 0).sum(axis=1) == 1
    for row, side in zip(G[single], h[single], strict=True):
        at = int(np.flatnonzero(row)[0])
        if row[at] > 0:
            upper[at] = min(upper[at], side / row[at])
        else:
            lower[at] = max(lower[at], side / row[at])
    C = np.concatenate([G[~single], A])
    low = np.concatenate([np.full((~single).sum(), -np.inf), b])
    return P, q, C, low, np.concatenate([h[~single], b]), lower, upper


def _gap(
    P: np.ndarray, q: np.ndarray, C: np.ndarray, low: Any, high: Any, x: np.ndarray, y: np.ndarray
) -> tuple[float, float, float]:
    """Primal residual, dual residual and duality gap."""
    A = np.vstack([C, np.eye(len(q))])
    if len(y) < len(A):
        y = np.r_[np.zeros(len(A) - len(y)), y]
    value = A @ x
    primal = np.maximum(np.maximum(value - high, low - value), 0.0).max(initial=0.0)
    dual = np.abs(P @ x + q + A.T @ y).max()
    side = np.where(y > 0, high, np.where(y < 0, low, 0.0))
    return float(primal), float(dual), abs(float(x @ P @ x + q @ x + y @ side))


def _by_daqp(
    P: np.ndarray, q: np.ndarray, C: np.ndarray, low: Any, high: Any, lower: Any, upper: Any
) -> Any:
    import daqp

    top, bottom = (np.clip(np.r_[a], -1e30, 1e30) for a in ((*upper, *high), (*lower, *low)))
    sense = np.zeros(len(top), np.int32)
    return lambda _: daqp.solve(
        P, q, np.ascontiguousarray(C), top, bottom, sense, primal_tol=TOLERANCE, dual_tol=TOLERANCE
    )


# ---------------------------------------------------------------- long horizons


def riccati_step(steps: int, states: int, inputs: int) -> dict[str, float]:
    """Time of one Newton step of a sparse interior point [us], by ``scan`` and in parallel.

    Its factorisation is a Riccati recursion over the stages; ``associative_scan`` runs it in a
    logarithmic number of levels (Sarkka and Garcia-Fernandez, 2023). An interior point takes five
    to ten of these steps, so one of them is a floor of the whole solve.
    """
    rng = np.random.default_rng(0)
    A = jnp.asarray(np.eye(states) + 0.02 * rng.normal(size=(steps, states, states)))
    B = jnp.asarray(0.02 * rng.normal(size=(steps, states, inputs)))
    Q = jnp.asarray(np.broadcast_to(np.eye(states), (steps, states, states)))
    R = jnp.asarray(0.1 + rng.random((steps, inputs)))  # weights and barrier, different everywhere
    eye = jnp.eye(states)

    def in_sequence(R: Any) -> Any:
        def stage(V: Any, row: Any) -> Any:
            A, B, Q, R = row
            M = jnp.diag(R) + B.T @ V @ B
            K = jnp.linalg.solve(M, B.T @ V @ A)
            return Q + A.T @ V @ (A - B @ K), K

        return jax.lax.scan(stage, eye, (A, B, Q, R), reverse=True)[1]

    def in_parallel(R: Any) -> Any:
        C = jnp.einsum("tij,tj,tkj->tik", B, 1.0 / R, B)

        def join(later: Any, earlier: Any) -> Any:  # reversed: the later element comes first
            A2, C2, J2 = later
            A1, C1, J1 = earlier
            middle = jnp.linalg.inv(eye + C1 @ J2)
            return (
                A2 @ middle @ A1,
                A2 @ middle @ C1 @ A2.mT + C2,
                A1.mT @ J2 @ middle @ A1 + J1,
            )

        J = jax.lax.associative_scan(join, (A, C, Q), reverse=True)[2]
        V = jnp.concatenate([J[1:], eye[None]])
        M = jax.vmap(jnp.diag)(R) + B.mT @ V @ B
        return jnp.linalg.solve(M, B.mT @ V @ A)

    times = {}
    for name, step in (("riccati, scan", in_sequence), ("riccati, associative", in_parallel)):
        times[name] = _median_us(partial(_on, jax.jit(step), R))
    return times


def _on(call: Callable[[Any], Any], argument: Any, _: int) -> Any:
    return call(argument)
