"""Derivatives of a few physics steps through contact, in forward mode, on MJX.

What MJX promises and what not:

- Forward mode only. The contact solver is a ``while_loop``, which reverse mode cannot walk back.
- The derivative is that of the solver's last iterate: give it iterations enough to converge, or
  the derivative lags behind the state (it converges one order later).
- Pyramidal cones on the JAX implementation. Where a contact opens or closes, or a pyramid's edge
  is passed, the one-sided derivative of the present set of contacts comes back.
- Every column is a tangent that runs along: cost grows with the number of inputs, so this is for
  some ten inputs, not for weights by the hundred; for those see ``kjax.tuning``.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from kjax.sim.mjx_import import mjx, mjx_step


class Sensitivity(NamedTuple):
    """End of a rollout and its derivatives; y = (qpos, qvel), for models without quaternions.

    Attributes:
      y: (nq + nv,) state at the end.
      by_state: (nq + nv, nq + nv) dy / d(qpos, qvel) at the start.
      by_control: (nq + nv, nu) dy / d ctrl, held all the time [1/(N m)].
    """

    y: Float[Array, "n"]
    by_state: Float[Array, "n n"]
    by_control: Float[Array, "n nu"]


def build_sensitivity(
    model: mujoco.MjModel, steps: int, *, iterations: int = 30
) -> Callable[[Array, Array, Array], Sensitivity]:
    """Function (qpos, qvel, ctrl) -> ``Sensitivity`` after ``steps`` physics steps; jit it.

    Args:
      model: without free or ball joints, pyramidal cones.
      steps: number of physics steps.
      iterations: of the contact solver, and of its line search.

    Raises:
      ValueError: for a model whose derivative would not be what it says.
    """
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    if model.nq != model.nv:
        raise ValueError(
            f"model must have no free or ball joint (nq = nv), got nq = {model.nq}, nv = {model.nv}"
        )
    if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
        raise ValueError("model must have pyramidal friction cones, got elliptic ones")
    own = mjx.put_model(model)
    option = own.opt.replace(iterations=iterations, ls_iterations=iterations)
    own = own.replace(opt=option)
    nq = model.nq

    def roll(y: Array, ctrl: Array) -> Array:
        data = mjx.make_data(own)
        data = data.replace(qpos=y[:nq].astype(data.qpos.dtype), qvel=y[nq:], ctrl=ctrl)
        data = jax.lax.fori_loop(0, steps, lambda _, d: _same(mjx_step(own, d), d), data)
        return jnp.concatenate([data.qpos, data.qvel])

    def sensitivity(qpos: Array, qvel: Array, ctrl: Array) -> Sensitivity:
        y = jnp.concatenate([qpos, qvel])
        by_state, by_control = jax.jacfwd(roll, argnums=(0, 1))(y, ctrl)
        return Sensitivity(roll(y, ctrl), by_state, by_control)

    return sensitivity


def _same(new: mjx.Data, old: mjx.Data) -> mjx.Data:
    """MJX's step in the types that it was given."""
    return jax.tree.map(lambda a, b: a.astype(b.dtype), new, old)
