"""The LMPC as tables: everything that a contact mode fixes is built once, off line.

On line a plan is: lift, one matrix-vector product for the linear term, one box QP. Rows on the
forces are checked at its solution; only where one is violated a QP with rows follows.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from kjax import qp
from kjax.koopman.models import LinearModel, aggregate, input_map
from kjax.mpc.condense import CondensedQp, condense, discounted_weights
from kjax.mpc.cycle_rollout import CycleMemory, start_cycle
from kjax.mpc.limits import ForceRows
from kjax.spec import ControllerSpec


class LmpcTables(NamedTuple):
    """Condensed problems, one for each contact mode of each gait (M problems, nu = n_u k).

    Attributes:
      hessian: prepared Hessians, for the model's nominal contact points.
      F: (M, nu, N) linear term per lifted state.
      G: (M, nu, n_x k) linear term per (negative) reference.
      q_input: (M, nu) constant linear term -2 R u_ref.
      lower: (M, nu) lower force bounds, body frame [N]; swing ends are fixed to 0.
      upper: (M, nu) upper force bounds [N].
      model: prediction models over one model_dt, for contact points measured on line.
      spread: (M, n_x) standard deviation of their error over one model_dt [m, rad, m/s, rad/s].
      state_weights: (M, n_x) diagonal of Q.
      input_weights: (M, n_u) diagonal of R [1/N^2].
      uncertainty_discount: see ``condense.discounted_weights`` [-].
    """

    hessian: qp.Prepared
    F: Float[Array, "M nu N"]
    G: Float[Array, "M nu nx"]
    q_input: Float[Array, "M nu"]
    lower: Float[Array, "M nu"]
    upper: Float[Array, "M nu"]
    model: LinearModel
    spread: Float[Array, "M n_x"]
    state_weights: Float[Array, "M n_x"]
    input_weights: Float[Array, "M n_u"]
    uncertainty_discount: Float[Array, ""]


class LmpcMemory(NamedTuple):
    """What the LMPC carries from tick to tick.

    Attributes:
      plan: (n_u k,) last force plan, body frame [N].
      problem: that it solves; -1 before the first.
      warm: where the QP of that problem may go on from; ``None`` where nothing is carried.
      cycle: last plan over a gait cycle; ``None`` where none is made about it.
    """

    plan: Float[Array, "nu"]
    problem: Int[Array, ""]
    warm: qp.Warm | None
    cycle: CycleMemory | None = None


class ModeSettings(NamedTuple):
    """Weights and bounds of every problem (M of them).

    Attributes:
      state_weights: (M, n_x) diagonal of Q.
      input_weights: (M, n_u) diagonal of R [1/N^2].
      lower: (M, n_u) lower force bounds, body frame [N].
      upper: (M, n_u) upper force bounds [N].
      input_reference: (M, n_u) forces that R penalises the distance from [N].
    """

    state_weights: Float[Array, "M n_x"]
    input_weights: Float[Array, "M n_u"]
    lower: Float[Array, "M n_u"]
    upper: Float[Array, "M n_u"]
    input_reference: Float[Array, "M n_u"]


def build_tables(
    model: LinearModel,
    settings: ModeSettings,
    *,
    steps: int,
    horizon: int,
    feet: Float[Array, "M 2 2"],
    spread: Float[Array, "M n_x"] | None = None,
    uncertainty_discount: Float[Array, ""] | float | None = None,
) -> LmpcTables:
    """Tables of all contact modes; call it in float64.

    Args:
      model: one-step models of all modes.
      settings: weights and bounds of all modes.
      steps: number of model steps that one step of the prediction holds.
      horizon: number k of prediction steps.
      feet: (M, 2, 2) nominal contact points [m].
      spread: (M, n_x) standard deviation of the one-step error of each model; ``None`` for none.
      uncertainty_discount: by how much uncertain steps weigh less, see
        ``condense.discounted_weights``; ``None`` for all alike [-].
    """
    model = jax.vmap(lambda one: aggregate(one, steps))(model)
    Q, R, lower, upper, u_ref = settings

    swinging = jnp.tile(lower == upper, (1, horizon))
    # White from step to step.
    spread = jnp.zeros_like(Q) if spread is None else spread * steps**0.5

    def one(
        model: LinearModel, Q: Array, R: Array, feet: Array, swinging: Array, spread: Array
    ) -> tuple[qp.Prepared, Array, Array]:
        if uncertainty_discount is not None:
            Q = discounted_weights(model.A, Q, spread, uncertainty_discount, horizon)
        problem = condense(model.A, input_map(model, feet), Q, R, horizon)
        return qp.prepare(problem.H, swinging), problem.F, problem.G

    hessian, F, G = jax.vmap(one)(model, Q, R, feet, swinging, spread)
    return LmpcTables(
        hessian=hessian,
        F=F,
        G=G,
        q_input=jnp.tile(-2.0 * R * u_ref, (1, horizon)),
        lower=jnp.tile(lower, (1, horizon)),
        upper=jnp.tile(upper, (1, horizon)),
        model=model,
        spread=spread,
        state_weights=Q,
        input_weights=R,
        uncertainty_discount=jnp.asarray(
            0.0 if uncertainty_discount is None else uncertainty_discount, float
        ),
    )


class LmpcSolution(NamedTuple):
    """Result of ``solve_lmpc``.

    Attributes:
      plan: (n_u k,) inputs, n_u per step, body frame [N].
      status: a ``qp.Status``.
      residual: relative, of the QP [-].
      iterations: of the solver.
      warm: for the next tick in the same mode; ``None`` where nothing is carried.
    """

    plan: Float[Array, "nu"]
    status: Int[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    warm: qp.Warm | None


def start_memory(tables: LmpcTables, spec: ControllerSpec) -> LmpcMemory:
    """Memory before the first tick; with a tableau where the Hessian of a mode stays what it is."""
    warm = None
    hessian_stays = spec.model.tabulated and not spec.model.measured_feet
    if hessian_stays and spec.warm_start and spec.solver == "tableau":
        warm = qp.start(jax.tree.map(lambda a: a[0], tables.hessian))
    follows = spec.cycle is not None and spec.cycle.linearise == "last_plan"
    return LmpcMemory(
        plan=jnp.zeros_like(tables.lower[0]),
        problem=jnp.full((), -1, jnp.int32),
        warm=warm,
        cycle=start_cycle(spec.cycle.grid, tables.lower) if spec.cycle and follows else None,
    )


def solve_lmpc(
    tables: LmpcTables,
    problem: Int[Array, ""],
    z: Float[Array, "N"],
    reference: Float[Array, "k n_x"],
    memory: LmpcMemory,
    spec: ControllerSpec,
    model: LinearModel | None = None,
    rows: ForceRows | None = None,
) -> LmpcSolution:
    """Force plan of one tick.

    Eight arguments: two of them, ``model`` and ``rows``, replace or add to the tables.

    Args:
      tables: of all problems.
      problem: index; traced.
      z: lifted state, of the tables' models or of ``model``.
      reference: (k, n_x) states wanted.
      memory: of the last tick.
      spec: horizon and solver.
      model: over one model_dt and for the contact points as they are, in place of the tables' own.
      rows: on the forces of every step, besides the box.
    """
    lower, upper = tables.lower[problem], tables.upper[problem]
    if model is None:
        hessian, index, F, G = tables.hessian, problem, tables.F[problem], tables.G[problem]
    else:
        condensed = _condensed(tables, problem, spec, model)
        hessian, index = qp.prepare(condensed.H, lower == upper), None
        F, G = condensed.F, condensed.G
    q = F @ z - G @ reference.reshape(-1) + tables.q_input[problem]

    warm = _warm_start(tables, problem, memory, spec)
    options: dict[str, Any] = {
        "index": index,
        "tolerance": spec.tolerance,
        "max_iterations": spec.max_iterations,
    }
    solution: qp.Solution | qp.BoxRowSolution
    if rows is None:
        solution = qp.solve(hessian, q, lower, upper, warm, method=spec.solver, **options)
    else:
        solution = qp.solve_rows_from_box(
            hessian,
            q,
            jnp.kron(jnp.eye(spec.horizon, dtype=q.dtype), rows.A),
            jnp.tile(rows.low, spec.horizon),
            jnp.tile(rows.high, spec.horizon),
            lower,
            upper,
            warm,
            box_method=spec.solver,
            row_method="admm" if spec.solver == "admm" else "active_set",
            **options,
        )
    kept = None if memory.warm is None else solution.warm
    return LmpcSolution(solution.x, solution.status, solution.residual, solution.iterations, kept)


def _condensed(
    tables: LmpcTables, problem: Array, spec: ControllerSpec, model: LinearModel
) -> CondensedQp:
    """The problem's weights on another model than the tables' own."""
    Q, R = tables.state_weights[problem], tables.input_weights[problem]
    if spec.discounts_uncertainty:
        Q = discounted_weights(
            model.A, Q, tables.spread[problem], tables.uncertainty_discount, spec.horizon
        )
    return condense(model.A, model.B, Q, R, spec.horizon)


def _warm_start(
    tables: LmpcTables, problem: Array, memory: LmpcMemory, spec: ControllerSpec
) -> qp.Warm | Array | None:
    """Where the box QP goes on from: the last tick's tableau, or for other solvers its plan."""
    if memory.warm is None:
        return None if spec.solver == "tableau" else shift_plan(memory.plan, spec)
    # Another problem is another Hessian: its own cold start then.
    cold = (tables.hessian.table[problem], tables.hessian.bound_status[problem])
    table, bound_status = jax.tree.map(
        lambda old, new: jnp.where(problem == memory.problem, old, new),
        (memory.warm.table, memory.warm.bound_status),
        cold,
    )
    return qp.Warm(x=memory.warm.x, table=table, bound_status=bound_status)


def shift_plan(plan: Float[Array, "nu"], spec: ControllerSpec) -> Float[Array, "nu"]:
    """The last plan one control tick later, its final step repeated: the next warm start."""
    blocks = plan.reshape(spec.horizon, -1)
    steps = min(round(spec.control_dt / spec.model_dt), spec.horizon - 1)
    index = np.minimum(np.arange(spec.horizon) + steps, spec.horizon - 1)
    return blocks[index].reshape(-1)
