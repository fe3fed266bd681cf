"""Random QPs of every kind and scale for every method, counted: what is called solved, and is not.

Problems are drawn in batches from a known KKT point, so that the least cost is known without a
solver; the judge is plain NumPy. Linear programs that are not drawn so go to HiGHS.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import linprog
from tqdm import tqdm

from kjax import qp

TOLERANCE = 1e-9
SHAPES = ((2, 3), (5, 8), (12, 16), (24, 36))  # variables, rows
BATCH = 256
KINDS = ("known", "infeasible", "unbounded", "box", "linear")
# Of that many batches a method solves one: in a batch all wait for the slowest, and first-order
# methods take up to thousands of iterations.
EVERY = {"interior_point": 2, "admm": 8, "box admm": 8, "box projected_gradient": 8}
COUNTS = (
    "problems", "solved", "proven", "iteration_limit", "other",
    "wrong_solved", "wrong_infeasible", "wrong_unbounded",
)  # fmt: skip


class Problems(NamedTuple):
    """A batch (B) of problems in the order of ``qp.solve_rows``, and what is known of them.

    Attributes:
      data: H (B, n, n), q (B, n), C (B, m, n), row bounds (B, m), box (B, n).
      unit: (B, n) unit of each variable, for what rounding leaves.
      least: (B,) the least cost; NaN where there is none.
      terms: (B,) size of the terms that make it up.
      wanted: the right status.
    """

    data: tuple[np.ndarray, ...]
    unit: np.ndarray
    least: np.ndarray
    terms: np.ndarray
    wanted: qp.Status


def draw(rng: np.random.Generator, kind: str, count: int, n: int, m: int) -> Problems:
    """A batch of one kind; rank of H, activity, repeated rows and all units are drawn as well."""
    C = rng.normal(size=(count, m, n)) * (rng.random((count, m, n)) < 0.7)
    x = rng.normal(size=(count, n)) * 10.0 ** rng.uniform(-2, 2, (count, 1))
    H, rank = _hessian(rng, kind, count, n)
    if kind == "unbounded":
        H, down = _exactly_singular(rng, rank[:, 0], n)

    zero = rng.random((count, m)) < 0.1  # rows that nothing moves
    C = np.where(zero[..., None], 0.0, C)
    if m > 2:
        again = rng.random((count, 1)) < 0.3  # the same row twice
        C[:, 1] = np.where(again, 3.0 * C[:, 0], C[:, 1])
    fixed = rng.random((count, n)) < np.where(rng.random((count, 1)) < 0.3, 0.3, 0.0)
    equal = rng.random((count, m)) < np.where(rng.random((count, 1)) < 0.3, 0.15, 0.0)
    if kind == "unbounded":
        fixed[:] = False
        size = (down**2).sum(-1, keepdims=True)
        flat = C - np.einsum("bmn,bn->bm", C, down)[..., None] * (down / size)[:, None]
        C = np.where(equal[..., None], flat, C)
    if kind == "box":
        C = C[:, :0]
        equal = equal[:, :0]
    A = np.concatenate([C, np.broadcast_to(np.eye(n), (count, n, n))], axis=1)
    M = A.shape[1]
    value = np.einsum("bmn,bn->bm", A, x)
    value[:, M - n :] = x
    held = np.concatenate([equal, fixed], axis=1)
    side = rng.integers(0, 4, (count, M))  # 0 at the lower side, 1 at the upper, else at neither
    width = 10.0 ** rng.uniform(-2, 2, (count, 1)) * rng.uniform(0.1, 2.0, (2, count, M))
    low = np.where(held | (side == 0), value, value - width[0])
    high = np.where(held | (side == 1), value, value + width[1])
    loose = rng.random((count, 1)) < 0.5  # some sides are missing
    low = np.where(loose & (side != 0) & ~held & (rng.random((count, M)) < 0.4), -np.inf, low)
    high = np.where(loose & (side != 1) & ~held & (rng.random((count, M)) < 0.4), np.inf, high)
    push = rng.uniform(0.01, 1.0, (count, M))
    y = np.select([held, side == 0, side == 1], [rng.normal(size=(count, M)), -push, push], 0.0)
    wanted = qp.Status.SOLVED

    if kind == "unbounded":
        along = np.einsum("bmn,bn->bm", A, down)
        along[:, :m][equal] = 0.0
        low = np.where(along < -1e-12, -np.inf, low)
        high = np.where(along > 1e-12, np.inf, high)
        y = np.where(np.where(y > 0, high < np.inf, low > -np.inf), y, 0.0)
        wanted = qp.Status.UNBOUNDED
    q = -(np.einsum("bij,bj->bi", H, x) + np.einsum("bmn,bm->bn", A, y))
    if kind == "unbounded":
        fall = (q * down).sum(-1, keepdims=True) + 10.0 ** rng.uniform(-2, 0, (count, 1)) * (
            np.abs(q).max(-1, keepdims=True) + 1e-3
        )
        q = q - fall * down / (down**2).sum(-1, keepdims=True)
    if kind == "infeasible":
        C, low, high = _contradict(rng, C, low, high, m, fixed, x)
        wanted = qp.Status.INFEASIBLE

    data, x, y, unit = _scaled(rng, (H, q, C, low, high), x, y)
    if kind == "infeasible":
        y = y * 0.0
    terms = _terms(data, x, y)
    least = _cost(data[0], data[1], x) if wanted == qp.Status.SOLVED else np.full(count, np.nan)
    return Problems(data, unit, least, terms, wanted)


def _hessian(
    rng: np.random.Generator, kind: str, count: int, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """H (B, n, n) and its rank (B, 1); condition and scale against the rest are drawn as well."""
    basis = np.linalg.qr(rng.normal(size=(count, n, n)))[0]
    rank = np.full((count, 1), n) if kind == "box" else rng.integers(0, n + 1, (count, 1))
    rank = np.where(rng.random((count, 1)) < 0.4, n, rank)
    if kind == "linear":
        rank = np.zeros_like(rank)
    spread = 10.0 ** -(rng.uniform(0, 6, (count, 1)) * np.linspace(0, 1, n))
    spectrum = np.where(np.arange(n) < rank, spread, 0.0)
    H = np.einsum("bij,bj,bkj->bik", basis, spectrum, basis)
    H = 0.5 * (H + H.transpose(0, 2, 1)) * 10.0 ** rng.uniform(-14, 14, (count, 1, 1))
    H[rank[:, 0] == 0] = 0.0
    return H, rank


def _scaled(
    rng: np.random.Generator, problem: tuple[np.ndarray, ...], x: np.ndarray, y: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
    """Problem, point and multipliers in random units of variables, rows and cost; the units (B, n).

    Args:
      rng: of the units.
      problem: H, q, C, and the lower and upper bounds (B, m + n) of rows and variables.
      x: (B, n).
      y: (B, m + n).
    """
    H, q, C, low, high = problem
    count, m, n = C.shape
    unit = 2.0 ** np.where(rng.random((count, 1)) < 0.5, rng.integers(-10, 11, (count, n)), 0)
    row = 2.0 ** rng.integers(-5, 6, (count, m))
    cost = 2.0 ** rng.integers(-26, 27, (count, 1))
    H = H * cost[..., None] / unit[:, :, None] / unit[:, None]
    q, x = q * cost / unit, x * unit
    C = C * row[..., None] / unit[:, None]
    data = (
        H, q, C, low[:, :m] * row, high[:, :m] * row, low[:, m:] * unit, high[:, m:] * unit,
    )  # fmt: skip
    return data, x, y * cost / np.concatenate([row, unit], axis=1), unit


def _exactly_singular(
    rng: np.random.Generator, rank: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """H (B, n, n) of at most that rank, and d (B, n) with H d = 0 to the last bit: integers."""
    count = len(rank)
    d = rng.integers(-1, 2, (count, n)).astype(float)
    d[:, 0] = 1.0
    factor = rng.integers(-8, 9, (count, n, n)).astype(float)
    factor *= np.arange(n) < rank[:, None, None]  # columns
    factor[:, 0] = 0.0
    # x_i - d_i x_0 is all that H sees.
    sees = np.broadcast_to(np.eye(n), (count, n, n)).copy()
    sees[:, :, 0] -= d
    F = np.einsum("bir,bij->brj", factor, sees)
    scale = 2.0 ** rng.integers(-46, 47, (count, 1, 1))
    return np.einsum("bri,brj->bij", F, F) * scale, d


def _contradict(
    rng: np.random.Generator, C: Any, low: Any, high: Any, m: int, fixed: Any, x: Any
) -> tuple[np.ndarray, ...]:
    """One of three reasons why there is no point: two rows, three rows, or an immovable one."""
    count = len(C)
    C, low, high = C.copy(), low.copy(), high.copy()
    size = np.abs(x).max(-1)
    gap = size * 10.0 ** rng.uniform(-3, 1, count)
    why = rng.integers(0, 3 if m > 2 else 2, count)
    C[:, 0] = np.where(np.abs(C[:, 0]).max(-1, keepdims=True) > 0.1, C[:, 0], 1.0)
    value = np.einsum("bn,bn->b", C[:, 0], x)
    two, none, three = why == 0, why == 1, why == 2
    C[two, 1] = -2.0 * C[two, 0]
    low[:, 0], high[:, 0] = value, value + size
    low[two, 1], high[two, 1] = (-2.0 * value + gap)[two], np.inf
    C[none, 1] = 0.0
    low[none, 1], high[none, 1] = gap[none], np.inf
    if m > 2:
        C[three, 2] = -C[three, 0] - C[three, 1]
        other = np.einsum("bn,bn->b", C[:, 1], x)
        low[three, 1], high[three, 1] = other[three], np.inf
        low[three, 2], high[three, 2] = (gap - value - other)[three], np.inf
    return C, low, high


def _cost(H: np.ndarray, q: np.ndarray, x: np.ndarray) -> np.ndarray:
    return 0.5 * np.einsum("bi,bij,bj->b", x, H, x) + np.einsum("bi,bi->b", q, x)


def _terms(data: tuple[np.ndarray, ...], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """|x|^T |H| |x| + |q|^T |x|, and what the multipliers balance it with."""
    H, q, C = (np.abs(a) for a in data[:3])
    x, y, m = np.abs(x), np.abs(y), C.shape[1]
    pushes = np.einsum("bm,bmn,bn->b", y[:, :m], C, x) + np.einsum("bn,bn->b", y[:, m:], x)
    return np.einsum("bi,bij,bj->b", x, H, x) + np.einsum("bi,bi->b", q, x) + pushes


def is_solution(problems: Problems, x: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """Whether each point keeps its rows and box and has the least cost, (B,)."""
    H, q, C, *bounds = problems.data
    low = np.concatenate([bounds[0], bounds[2]], axis=1)
    high = np.concatenate([bounds[1], bounds[3]], axis=1)
    with np.errstate(invalid="ignore"):
        value = np.concatenate([np.einsum("bmn,bn->bm", C, x), x], axis=1)
        terms = np.concatenate([np.einsum("bmn,bn->bm", np.abs(C), np.abs(x)), np.abs(x)], axis=1)
        reach = np.abs(x / problems.unit).max(-1, keepdims=True)
        largest = np.einsum("bmn,bn->bm", np.abs(C), problems.unit) * reach
        rounding = 1e-13 * np.concatenate([largest, np.zeros_like(x)], axis=1)
        violation = np.maximum(low - value, value - high)
        bound = np.where(low > value, low, high)
        bound = np.where(violation > 0, np.abs(bound), 0.0)
        kept = (violation <= 1.1 * tolerance * (bound + terms) + rounding).all(-1)
        size = problems.terms + _terms(problems.data, x, np.zeros_like(low))
        error = np.abs(_cost(H, q, x) - problems.least)
    return kept & np.isfinite(x).all(-1) & (error <= 10.0 * tolerance * size)


def linear_program_cost(data: tuple[np.ndarray, ...]) -> float | None:
    """The least cost of one linear program by HiGHS; ``None`` where it finds none."""
    _, q, C, low, high, lower, upper = data
    rows, sides = [], []
    for a, lo, up in zip(C, low, high, strict=True):
        for row, side in ((a, up), (-a, -lo)):
            if np.isfinite(side):
                rows.append(row)
                sides.append(side)
    found = linprog(
        q, A_ub=np.array(rows) if rows else None, b_ub=np.array(sides) if rows else None,
        bounds=list(zip(lower, upper, strict=True)), method="highs",
    )  # fmt: skip
    return float(found.fun) if found.status == 0 else None


def _box_solver(method: qp.Method) -> Any:
    """A compiled function of a batch: x and status. Its rows have no members."""

    def solve(H: Any, q: Any, C: Any, a: Any, b: Any, lower: Any, upper: Any) -> Any:
        del C, a, b
        found = qp.solve(qp.prepare(H), q, lower, upper, method=method, tolerance=TOLERANCE)
        return found.x, found.status

    return jax.jit(jax.vmap(solve))


def _row_solver(method: qp.RowMethod) -> Any:
    def solve(*data: Any) -> Any:
        found = qp.solve_rows(*data, method=method, tolerance=TOLERANCE)
        return found.x, found.status

    return jax.jit(jax.vmap(solve))


def count(
    total: int, methods: Any = None, shapes: Any = None, kinds: Any = KINDS, seed: int = 0
) -> dict[str, dict[str, int]]:
    """Outcomes by method and kind over about ``total`` solves; slow methods get fewer of them."""
    shapes = SHAPES if shapes is None else shapes
    rng = np.random.default_rng(seed)
    result: dict[str, dict[str, int]] = {}
    rows = {method: _row_solver(method) for method in qp.ROW_METHODS}
    every = {f"box {method}": _box_solver(method) for method in qp.METHODS} | rows
    chosen = {
        kind: {
            name: solve
            for name, solve in (every if kind == "box" else rows).items()
            if methods is None or name in methods
        }
        for kind in kinds
    }
    share = sum(1 / EVERY.get(name, 1) for names in chosen.values() for name in names)
    rounds = max(1, round(total / (share * len(shapes) * BATCH)))
    jobs = [(kind, shape, i) for shape in shapes for kind in kinds for i in range(rounds)]
    for kind, (n, m), i in tqdm(jobs, desc="random QPs with rows", leave=False, disable=None):
        problems = draw(rng, kind, BATCH, n, m)
        for name, solve in chosen[kind].items():
            if i % EVERY.get(name, 1) == 0:
                x, status = map(np.asarray, solve(*problems.data))
                entry = result.setdefault(f"{name}, {kind}", dict.fromkeys(COUNTS, 0))
                _tally(entry, problems, x, status)
    return result


def wrong(counts: dict[str, dict[str, int]]) -> int:
    """All wrong answers of ``count``."""
    return sum(n for entry in counts.values() for k, n in entry.items() if k.startswith("wrong"))


def _tally(entry: dict[str, int], problems: Problems, x: np.ndarray, status: np.ndarray) -> None:
    solved, Status = status == qp.Status.SOLVED, qp.Status
    right = is_solution(problems, x)
    known = (Status.SOLVED, Status.INFEASIBLE, Status.UNBOUNDED, Status.ITERATION_LIMIT)
    entry["problems"] += len(x)
    entry["solved"] += int(solved.sum())
    entry["proven"] += int((status == problems.wanted).sum())
    entry["iteration_limit"] += int((status == Status.ITERATION_LIMIT).sum())
    entry["other"] += int((~np.isin(status, known)).sum())
    entry["wrong_solved"] += int((solved & ~right).sum())
    for name, claim in (("infeasible", Status.INFEASIBLE), ("unbounded", Status.UNBOUNDED)):
        if problems.wanted != claim:
            entry[f"wrong_{name}"] += int((status == claim).sum())
