"""The same closed loop inside ``lax.scan`` on MJX: physics, phase clock, QP and legs in one jit.

Outer scan over control ticks, inner scan over physics steps, so that a plan is computed where it
is due and nowhere else, also under ``vmap``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float
from mujoco import mjx

from kjax.config import RunConfig
from kjax.controller import Controller, ControllerState, PlanInfo
from kjax.params import ControllerParams
from kjax.sim.observe import add_noise, build_observe, resolve
from kjax.sim.push import push_force, pushed_body
from kjax.sim.scene import build_spec


class MjxLog(NamedTuple):
    """What a run records; T ticks of S physics steps.

    Attributes:
      qpos: (T, S, nq) before each physics step.
      qvel: (T, S, nv) before each physics step.
      torque: (T, S, 4, 3) applied in it [N m].
      info: of every plan, leading axis T.
    """

    qpos: Float[Array, "T S nq"]
    qvel: Float[Array, "T S nv"]
    torque: Float[Array, "T S 4 3"]
    info: PlanInfo


class MjxSimulation(NamedTuple):
    """Functions of one scene and controller on MJX.

    Attributes:
      model: the C model that MJX's was made from.
      reset: (qpos, qvel) -> data, kinematics and sensors evaluated.
      run: (params, controller state, data, noise (T, S, 30 or 36)) -> (state, data, log).
    """

    model: mujoco.MjModel
    reset: Callable[[Array, Array], Any]
    run: Callable[
        [ControllerParams, ControllerState, Any, Array], tuple[ControllerState, Any, MjxLog]
    ]


def build_model(config: RunConfig) -> mujoco.MjModel:
    """The scene with the options that MJX needs: few solver iterations, feet-only contacts."""
    if config.sim.contacts != "feet" or config.sim.cone != "pyramidal":
        raise ValueError(
            "MJX needs sim.contacts = 'feet' and sim.cone = 'pyramidal', got "
            f"'{config.sim.contacts}' and '{config.sim.cone}'"
        )
    spec = build_spec(config.sim, config.terrain)
    spec.option.iterations = 6
    spec.option.ls_iterations = 8
    return spec.compile()


def build_mjx(config: RunConfig, controller: Controller) -> MjxSimulation:
    """Reset and run functions for a config; the caller jits and vmaps them."""
    model = build_model(config)
    mjx_model = mjx.put_model(model)
    observe = build_observe(model, config.sim.contact_threshold)
    actuators = resolve(model).actuator.reshape(-1)
    pushed = pushed_body(model)

    def reset(qpos: Array, qvel: Array) -> Any:
        data = mjx.make_data(mjx_model)
        # Through .at[], since a replaced host array has another layout and compiles twice.
        data = data.replace(qpos=data.qpos.at[:].set(qpos), qvel=data.qvel.at[:].set(qvel))
        return _same_types(mjx.forward(mjx_model, data), data)

    def run(
        params: ControllerParams, state: ControllerState, data: Any, noise: Array
    ) -> tuple[ControllerState, Any, MjxLog]:
        def sense(data: Any, noise: Array) -> Any:
            return add_noise(observe(data.qpos, data.qvel, data.sensordata), noise)

        def physics(carry: Any, noise: Array) -> Any:
            state, data = carry
            state, torque = controller.act(params, state, sense(data, noise))
            ctrl = jnp.zeros_like(data.ctrl).at[actuators].set(torque.reshape(-1))
            force = push_force(config.push, data.time, config.sim.sim_dt)
            pushes = jnp.zeros_like(data.xfrc_applied).at[pushed, :3].set(force)
            moved = mjx.step(mjx_model, data.replace(ctrl=ctrl, xfrc_applied=pushes))
            return (state, _same_types(moved, data)), (data.qpos, data.qvel, torque)

        def tick(carry: Any, noise: Array) -> Any:
            state, data = carry
            state, info = controller.plan(params, state, sense(data, noise[0]))
            carry, (qpos, qvel, torque) = jax.lax.scan(physics, (state, data), noise)
            return carry, MjxLog(qpos=qpos, qvel=qvel, torque=torque, info=info)

        (state, data), log = jax.lax.scan(tick, (state, data), noise)
        return state, data, log

    return MjxSimulation(model=model, reset=reset, run=run)


def _same_types(new: Any, old: Any) -> Any:
    """``new`` with the dtypes of ``old``: in float64 some contact ids change their width."""
    return jax.tree.map(lambda a, b: a.astype(b.dtype) if hasattr(a, "astype") else a, new, old)
