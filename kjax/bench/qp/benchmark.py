"""The QP solvers beside their peers, on the QPs of closed loops; run by benchmark.py qp."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax import qp
from kjax.bench.options import BenchOptions
from kjax.bench.qp import checks, random_rows, report
from kjax.bench.qp.peers import Solver, box_peers, daqp_cold
from kjax.bench.qp.problems import record_box, record_rows
from kjax.bench.timing import Call, median_us
from kjax.options import File, fail

BATCHES = (1, 4, 16, 64, 256, 1024, 4096)
HORIZONS = {40: 10, 80: 20, 200: 50, 400: 100}  # variables: steps of 20 ms of the long trot
SLOW = ("clarabel", "qpax", "piqp")  # left out at 400 variables
ROUNDS = 3  # of every timing; the medians over all calls are reported
PEERS = ("daqp", "quadprog", "osqp", "proxsuite", "piqp", "clarabel", "qpSWIFT", "qpax")
GAITS = ("trot_velocity", "bound_velocity")
RANDOM = 1_000_000  # warm-started solves that are judged


@dataclass(kw_only=True)
class QpOptions(BenchOptions):
    """Options of this benchmark."""

    problems: File = None
    """QPs to solve to 1e-9: a folder of .npz with P, q, G, h, A, b, lb, ub."""


OPTIONS = QpOptions


def run(folder: Path, args: QpOptions) -> dict[str, Any]:
    """All measurements; leaves figure.png and table.md in the folder."""
    quick, seconds = args.quick, 1.0 if args.quick else 6.0
    if args.problems is not None and not any(args.problems.glob("*.npz")):
        fail(f"--problems: no .npz file in {args.problems}")
    present = {name: _import(name) for name in PEERS}
    missing = [name for name, module in present.items() if module is None]
    if missing:
        print(f"not installed, left out: {', '.join(missing)} (pip install -e '.[peers]')")
    peers = {name: module for name, module in present.items() if module is not None}
    result: dict[str, Any] = {"missing": missing}
    result |= {part: {} for part in ("box", "batch", "size", "rows", "gradient")}
    for name in GAITS:
        print(f"{name}: 24 variables")
        log = record_box(name, seconds)
        result["gradient"][name] = checks.gradients(log, 100 if quick else 1000)
        result["box"][name] = box_single(log, peers)
        result["box"][name] |= box_in_scan(log)
        sizes = BATCHES[:4] if quick else BATCHES
        result["batch"][name] = box_batch(log, peers, sizes)
    for variables, steps in HORIZONS.items():
        print(f"trot_velocity_long: {variables} variables")
        log = record_box("trot_velocity_long", 0.5, {"lmpc.horizon": steps})
        fast = {k: v for k, v in peers.items() if variables < 400 or k not in SLOW}
        result["size"][variables] = box_single(log, fast, count=50)
        if variables >= 200:
            result["size"][variables] |= {
                name: {"us_median": us}
                for name, us in checks.riccati_step(steps, states=13, inputs=4).items()
            }
        if quick:
            break
    result["size"][24] = result["box"]["trot_velocity"]
    print("bound_multiphase: rows")
    result["rows"] = rows_single(record_rows(seconds), peers)
    print("random problems")
    result["random"] = checks.random_solves(RANDOM // 100 if quick else RANDOM)
    result["random_rows"] = random_rows.count(RANDOM // 100 if quick else RANDOM)
    result["random_rows_wrong"] = random_rows.wrong(result["random_rows"])
    if args.problems is not None:
        print(f"problems in {args.problems}")
        result["public"] = checks.public_problems(args.problems, peers)
    result |= summary(result)
    (folder / "table.md").write_text(report.table(result), encoding="utf-8")
    report.figure(result, folder / "figure.png")
    return result


def summary(result: dict[str, Any]) -> dict[str, Any]:
    """The figures that matter; where there are two gaits, the worse one. None if not measured."""

    def ratio(of: str, to: str, worst: Callable[..., Any]) -> Any:
        pairs = [(g.get(of), g.get(to)) for g in result["box"].values()]
        if any(a is None or b is None for a, b in pairs):
            return None
        return worst(a["us_median"] / b["us_median"] for a, b in pairs)

    single, scan = "kjax tableau, warm", "kjax in a scan, value"
    batches = [b.get("1024") or b[max(b, key=int)] for b in result["batch"].values()]
    loops = [b["daqp loop"] / b["kjax"] for b in batches if "daqp loop" in b]
    rows = {name: entry["us_median"] for name, entry in result["rows"].items()}
    rivals = [us for name, us in rows.items() if name.startswith(("PIQP", "ProxQP"))]
    return {
        "single_over_daqp_cold": ratio(single, "daqp, cold", max),
        "qpswift_over_single": ratio("qpSWIFT", single, min),
        "osqp_over_single": ratio("OSQP 1e-6", single, min),
        "qpax_over_single": ratio("qpax", single, min),
        "scan_over_daqp_warm": ratio(scan, "daqp, warm", max),
        "batch1024_over_daqp": min(loops) if loops else None,
        "grad_rel_err_median": max(g["median"] for g in result["gradient"].values()),
        "grad_rel_err_max": max(g["max"] for g in result["gradient"].values()),
        "grad_over_value": ratio("kjax in a scan, value and gradient", scan, max),
        "rows_over_best_of_piqp_proxqp": (
            rows["kjax active_set"] / min(rivals) if rivals else None
        ),
        "mpc_qpbenchmark_solved_1e9": result.get("public", {}).get("solved_1e9"),
        "random_wrong_solved": result["random"]["wrong_solved"],
    }


def _import(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def box_single(log: dict[str, Any], peers: dict[str, Any], count: int = 400) -> dict[str, Any]:
    """Latency of calls from Python along the log, tick by tick, and how good their points are."""
    q, lower, upper, mode = (log[k][:count] for k in ("q", "lower", "upper", "mode"))
    ticks, prepared = range(len(q)), log["prepared"]

    # Bounds change with the mode only: they stay in the compiled program, as H does.
    bounds = {
        int(m): (jnp.asarray(lower[mode == m][0]), jnp.asarray(upper[mode == m][0]))
        for m in np.unique(mode)
    }
    calls = {
        m: jax.jit(_one_mode(jax.tree.map(lambda a, m=m: a[m], prepared), *sides))
        for m, sides in bounds.items()
    }
    cold = {
        m: qp.start(jax.tree.map(lambda a, m=m: a[m], prepared)) for m in bounds
    }  # one tableau per mode, carried on when the mode comes back
    state: dict[str, Any] = {"warm": dict(cold)}

    def ours(i: int) -> np.ndarray:
        m = int(mode[i])
        x, warm = calls[m](q[i], state["warm"][m])
        state["warm"][m] = warm
        return np.asarray(x)

    def on_tick(by_mode: dict[int, Solver]) -> Callable[[int], np.ndarray]:
        return lambda i: by_mode[int(mode[i])](q[i], lower[i], upper[i])

    solvers: dict[str, Callable[[int], np.ndarray]] = {"kjax tableau, warm": ours}
    for name, make in box_peers(peers).items():
        by_mode = {int(m): make(log["H"][m]) for m in np.unique(mode)}
        solvers[name] = on_tick(by_mode)
    noop = jax.jit(lambda q, warm: (q + 1.0, warm))
    solvers["empty jitted call"] = lambda i: np.asarray(noop(q[i], state["warm"][int(mode[i])])[0])
    wanted = _reference(log, ticks)
    result: dict[str, Any] = {}
    times: dict[str, list[float]] = {name: [] for name in solvers}
    points = {}
    for round_ in range(ROUNDS):
        for name, solve in solvers.items():
            if round_ == 0:
                points[name] = [solve(i) for i in ticks]  # also warms up
            times[name].append(median_us(solve, ticks))
    residual = jax.jit(qp.kkt_residual)
    for name, values in times.items():
        entry = {"us_median": float(np.median(values))}
        if name != "empty jitted call":
            errors = [np.abs(p - w).max() for p, w in zip(points[name], wanted, strict=True)]
            entry["force_error_max_N"] = float(np.max(errors))
            entry["kkt_residual_max"] = max(
                float(residual(log["H"][mode[i]], q[i], lower[i], upper[i], points[name][i]))
                for i in ticks
            )
        result[name] = entry
    return result


def _one_mode(prepared: Any, lower: Any, upper: Any) -> Callable[..., Any]:
    def call(q: Any, warm: Any) -> Any:
        solution = qp.solve(prepared, q, lower, upper, warm)
        return solution.x, solution.warm

    return call


def _reference(log: dict[str, Any], ticks: range) -> list[np.ndarray]:
    """The minimisers to rounding: daqp with its tolerances at 1e-12."""
    import daqp

    n = log["q"].shape[1]
    none, sense = np.zeros((0, n)), np.zeros(n, np.int32)
    return [
        daqp.solve(
            log["H"][log["mode"][i]], log["q"][i], none, log["upper"][i], log["lower"][i], sense,
            primal_tol=1e-12, dual_tol=1e-12,
        )[0]
        for i in ticks
    ]  # fmt: skip


def box_in_scan(log: dict[str, Any]) -> dict[str, Any]:
    """Time per tick inside one compiled scan: value, and value with its gradient [us]."""
    data = tuple(jnp.asarray(log[k]) for k in ("mode", "q", "lower", "upper"))
    prepared, count = log["prepared"], len(log["q"])

    def tick(carry: Any, row: Any, weight: Any) -> Any:
        warm, last = carry
        mode, q, lower, upper = row
        cold = qp.start(jax.tree.map(lambda a: a[mode], prepared))
        warm = jax.tree.map(lambda old, new: jnp.where(mode == last, old, new), warm, cold)

        def value(q: Any) -> Any:
            solution = qp.solve(prepared, q, lower, upper, warm, index=mode)
            return solution.x.sum(), (solution.x, solution.warm)

        if weight:
            (_, (x, warm)), slope = jax.value_and_grad(value, has_aux=True)(q)
            return (warm, mode), (x, slope)
        _, (x, warm) = value(q)
        return (warm, mode), x

    start = qp.start(jax.tree.map(lambda a: a[0], prepared)), jnp.asarray(-1, data[0].dtype)
    result = {}
    for name, weight in (("value", False), ("value and gradient", True)):
        scan = jax.jit(
            lambda rows, weight=weight: jax.lax.scan(
                lambda carry, row: tick(carry, row, weight), start, rows
            )[1]
        )
        spent = median_us(_on(scan, data), range(15), warm_up=1)
        result[f"kjax in a scan, {name}"] = {"us_median": spent / count}
    return result


def _on(call: Callable[..., Any], *arguments: Any) -> Call:
    return lambda _: call(*arguments)


def _x_at(call: Callable[..., Any], problems: list[Any]) -> Call:
    return lambda i: np.asarray(call(*problems[i]))


def box_batch(log: dict[str, Any], peers: dict[str, Any], sizes: Any) -> dict[str, Any]:
    """Time per problem of a batch of ticks drawn at random, cold [us]."""
    rng = np.random.default_rng(0)
    prepared = log["prepared"]

    def one(mode: Any, q: Any, lower: Any, upper: Any) -> Any:
        return qp.solve(prepared, q, lower, upper, index=mode).x

    batch = jax.jit(jax.vmap(one))
    solvers = {int(m): daqp_cold(log["H"][m]) for m in np.unique(log["mode"])}
    result: dict[str, Any] = {}
    for size in sizes:
        pick = rng.choice(len(log["q"]), size)
        host = [log[k][pick] for k in ("mode", "q", "lower", "upper")]
        data = [jnp.asarray(a) for a in host]
        ours = median_us(_on(batch, *data), range(15), warm_up=1)
        entry = {"kjax": ours / size}
        if "daqp" in peers:

            def loop(_: int, host: Any = host) -> None:
                for mode, q, lower, upper in zip(*host, strict=True):
                    solvers[int(mode)](q, lower, upper)

            entry["daqp loop"] = median_us(loop, range(5)) / size
        result[str(size)] = entry
    return result


def rows_single(problems: list[Any], peers: dict[str, Any], count: int = 300) -> dict[str, Any]:
    """Latency on the bound's QPs with friction and torque rows, H new in every tick [us]."""
    problems = problems[:count]
    solvers: dict[str, Callable[[int], Any]] = {}
    for method in qp.ROW_METHODS:
        call = jax.jit(lambda *p, method=method: qp.solve_rows(*p, method=method).x)
        solvers[f"kjax {method}"] = _x_at(call, problems)
    n, m = problems[0][2].shape[1], problems[0][2].shape[0]
    clip = [[np.clip(a, -1e30, 1e30) for a in p] for p in problems]
    if "daqp" in peers:
        import daqp

        sense = np.zeros(n + m, np.int32)
        high = [np.r_[p[6], p[4]] for p in clip]
        low = [np.r_[p[5], p[3]] for p in clip]
        solvers["daqp, cold"] = lambda i: daqp.solve(
            clip[i][0], clip[i][1], clip[i][2], high[i], low[i], sense
        )[0]
    if "piqp" in peers:
        import piqp

        # The box among the rows: equal x_l and x_u it calls infeasible.
        stacked = [
            (
                p[0],
                p[1],
                None,
                None,
                np.vstack([p[2], np.eye(n)]),
                np.r_[p[3], p[5]],
                np.r_[p[4], p[6]],
            )
            for p in clip
        ]
        model = piqp.DenseSolver()
        model.setup(*stacked[0])

        def by_piqp(i: int) -> Any:
            model.update(*stacked[i])
            model.solve()
            return model.result.x

        solvers["PIQP"] = by_piqp
    if "proxsuite" in peers:
        import proxsuite

        prox = proxsuite.proxqp.dense.QP(n, 0, m, True)
        prox.init(*problems[0][:2], None, None, *problems[0][2:])  # it wants its infinities
        prox.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        prox.settings.max_iter = 200  # by default 10,000: some of these take seconds then

        def by_proxqp(i: int) -> Any:
            prox.update(*problems[i][:2], None, None, *problems[i][2:])
            prox.solve()
            return prox.results.x

        solvers["ProxQP, warm"] = by_proxqp
    ticks = range(len(problems))
    points = {name: [np.array(solve(i)) for i in ticks] for name, solve in solvers.items()}
    exact = points["kjax active_set"]
    result = {}
    for name, solve in solvers.items():
        spent = float(np.median([median_us(solve, ticks) for _ in range(ROUNDS)]))
        error = max(np.abs(a - b).max() for a, b in zip(points[name], exact, strict=True))
        result[name] = {"us_median": spent, "apart_from_active_set_max_N": float(error)}
    return result
