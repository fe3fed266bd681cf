"""The LMPC as tables: everything that a contact mode fixes is built once, off line.

On line a plan is: lift, one matrix-vector product for the linear term, one box QP.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax import qp
from kjax.config import LmpcConfig
from kjax.koopman.models import LinearModel, aggregate, input_map
from kjax.mpc.condense import condense
from kjax.srb import GRAVITY
from kjax.types import MODE_ALPHA


class LmpcTables(NamedTuple):
    """Condensed problems, stacked over ``types.Mode`` (M modes, nu = 4 k variables).

    Attributes:
      hessian: prepared Hessians, for the model's nominal contact points.
      F: (M, nu, N) linear term per lifted state.
      G: (M, nu, 6k) linear term per (negative) reference.
      q_input: (M, nu) constant linear term -2 R u_ref.
      lower: (M, nu) lower force bounds, body frame [N]; swing ends are fixed to 0.
      upper: (M, nu) upper force bounds [N].
      model: prediction models over one model_dt, for contact points measured on line.
      state_weights: (M, 6) diagonal of Q.
      input_weights: (M, 4) diagonal of R [1/N^2].
    """

    hessian: qp.Prepared
    F: Float[Array, "M nu N"]
    G: Float[Array, "M nu nx"]
    q_input: Float[Array, "M nu"]
    lower: Float[Array, "M nu"]
    upper: Float[Array, "M nu"]
    model: LinearModel
    state_weights: Float[Array, "M 6"]
    input_weights: Float[Array, "M 4"]


def build_tables(
    model: LinearModel, config: LmpcConfig, *, data_dt: float, mass: float, feet: Array
) -> LmpcTables:
    """Tables of all contact modes; call it in float64.

    Args:
      model: one-step models of all modes, step ``data_dt``.
      config: weights, bounds, horizon.
      data_dt: step of the fitted models [s].
      mass: body mass, for the hover force [kg].
      feet: (2, 2) nominal contact points [m].
    """
    steps = round(config.model_dt / data_dt)
    k = config.horizon
    model = jax.vmap(lambda one: aggregate(one, steps))(model)
    modes = len(MODE_ALPHA)
    Q = jnp.tile(jnp.asarray(config.state_weights), (modes, 1))
    R = jnp.full((modes, 4), config.input_weight)
    lower, upper, u_ref = force_bounds(config, mass)

    def one(model: LinearModel, Q: Array, R: Array) -> tuple[qp.Prepared, Array, Array]:
        problem = condense(model.A, input_map(model, feet), Q, R, k)
        return qp.prepare(problem.H), problem.F, problem.G

    hessian, F, G = jax.vmap(one)(model, Q, R)
    return LmpcTables(
        hessian=hessian,
        F=F,
        G=G,
        q_input=jnp.tile(-2.0 * R * u_ref, (1, k)),
        lower=jnp.tile(lower, (1, k)),
        upper=jnp.tile(upper, (1, k)),
        model=model,
        state_weights=Q,
        input_weights=R,
    )


def force_bounds(config: LmpcConfig, mass: float) -> tuple[Float[Array, "M 4"], ...]:
    """Lower bound, upper bound and reference of the four forces in every mode [N]."""
    standing = np.repeat(MODE_ALPHA > 0, 2, axis=1)
    lower = np.tile([-config.force_x_max, config.force_z_min], 2)
    upper = np.tile([config.force_x_max, config.force_z_max], 2)
    legs = np.maximum(MODE_ALPHA.sum(axis=1), 1)
    hover = np.outer(mass * GRAVITY / legs, [0.0, 1.0, 0.0, 1.0])
    reference = hover if config.input_reference == "hover" else np.zeros_like(hover)
    return tuple(jnp.asarray(np.where(standing, a, 0.0)) for a in (lower, upper, reference))


def reference_trajectory(
    *,
    position: Float[Array, ""],
    height: Float[Array, ""],
    velocity: Float[Array, ""],
    model_dt: float,
    horizon: int,
) -> Float[Array, "k 6"]:
    """Reference (k, 6) of steps 1..k: level trunk at constant height and forward velocity.

    Args:
      position: reference of p_x now [m].
      height: of the centre of mass [m].
      velocity: commanded v_x [m/s].
      model_dt: step of the prediction [s].
      horizon: number k of steps.
    """
    ahead = model_dt * jnp.arange(1, horizon + 1, dtype=position.dtype)
    zero = jnp.zeros_like(ahead)
    return jnp.stack(
        [position + velocity * ahead, zero + height, zero, zero + velocity, zero, zero], axis=-1
    )


def solve_lmpc(
    tables: LmpcTables,
    mode: Array,
    z: Float[Array, "N"],
    reference: Float[Array, "k 6"],
    warm: Float[Array, "nu"],
    config: LmpcConfig,
    feet: Float[Array, "2 2"] | None = None,
) -> qp.Solution:
    """Force plan: ``x`` of the solution is (4k,), four forces per step, body frame [N].

    Args:
      tables: of all modes.
      mode: contact mode, an index; traced.
      z: lifted state Pi(x).
      reference: (k, 6) states wanted.
      warm: (4k,) starting point [N].
      config: solver settings (static).
      feet: (2, 2) measured contact points [m]; ``None`` uses the tables' own.
    """
    stacked = tables if feet is not None else tables._replace(model=None)  # type: ignore[arg-type]
    now = jax.tree.map(lambda a: a[mode], stacked)
    if feet is None:
        hessian, F, G = now.hessian, now.F, now.G
    else:
        problem = condense(
            now.model.A,
            input_map(now.model, feet),
            now.state_weights,
            now.input_weights,
            config.horizon,
        )
        hessian, F, G = qp.prepare(problem.H), problem.F, problem.G
    q = F @ z - G @ reference.reshape(-1) + now.q_input
    return qp.solve(
        hessian,
        q,
        now.lower,
        now.upper,
        warm,
        method=config.solver,
        tolerance=config.tolerance,
        max_iterations=config.max_iterations,
    )


def shift_plan(plan: Float[Array, "nu"], config: LmpcConfig) -> Float[Array, "nu"]:
    """The last plan one control tick later, its final step repeated: the next warm start."""
    blocks = plan.reshape(config.horizon, 4)
    steps = min(round(config.control_dt / config.model_dt), config.horizon - 1)
    index = np.minimum(np.arange(config.horizon) + steps, config.horizon - 1)
    return blocks[index].reshape(-1)
