"""What happens between two control ticks: sums and extremes over the physics steps of each tick.

Batches record at the control rate; with these their metrics are those of the physics rate, and
nobody has to keep every step of a thousand robots.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from kjax.legs.base import Base, View
from kjax.sim.free_base import sole_speed
from kjax.sim.observe import Addresses, Observe
from kjax.sim.trajectory import Trajectory
from kjax.types import RobotParams

LIMIT = 0.999  # part of a joint's torque limit from which on it counts as saturated


class Window(NamedTuple):
    """The n physics steps of one control tick of one robot, and the state that they end in.

    Attributes:
      qpos: (n + 1, nq) positions before each step and after the last.
      qvel: (n + 1, nv) velocities.
      sensordata: (n + 1, ns) sensors.
      torque: (n, nu) in actuator order [N m].
    """

    qpos: Any
    qvel: Any
    sensordata: Any
    torque: Any


class TickStats(NamedTuple):
    """Over the steps of a tick; leading axes (P,), or (P, B) in a ``Recording``.

    Attributes:
      steps: their number; 0 where a value was not finite, and then all others are 0.
      velocity: sum of v_x [m/s].
      command_error: sum of the squares of v_x minus the command [m^2/s^2].
      reference_error: the same against what the LMPC tracks.
      pitch: largest |theta| [rad].
      height: sum of p_z [m].
      height_min: least p_z [m].
      height_max: largest p_z [m].
      slip: path along the ground of all feet that press [m].
      torque: largest |tau| [N m].
      saturated: number of steps in which a joint was at its limit.
      saturated_joints: (..., 3) the same for abduction, thigh and calf, mean of the legs.
    """

    steps: Any
    velocity: Any
    command_error: Any
    reference_error: Any
    pitch: Any
    height: Any
    height_min: Any
    height_max: Any
    slip: Any
    torque: Any
    saturated: Any
    saturated_joints: Any


# How the steps of a tick become one number; sums where nothing is said.
_EXTREMES = {"pitch": "max", "height_min": "min", "height_max": "max", "torque": "max"}

ReadWindow = Callable[[RobotParams, Any, Array, Window, Array, Array], TickStats]


def of_steps(
    x: Any, slip: Any, torque: Any, command: Any, reference: Any, limit: Any, xp: Any = np
) -> TickStats:
    """Each step on its own.

    Seven arguments: the six series that the statistics are of, and the library that computes them.

    Args:
      x: (n, 6) SRB states.
      slip: (n,) path of the feet in each step [m].
      torque: (n, 4, 3) [N m].
      command: (n,) velocity asked for [m/s].
      reference: (n,) velocity that the LMPC tracks [m/s].
      limit: (3,) torque limits [N m].
      xp: NumPy or jax.numpy.
    """
    at_limit = xp.abs(torque) >= LIMIT * limit
    one = xp.ones_like(slip)
    return TickStats(
        steps=one,
        velocity=x[:, 3],
        command_error=(x[:, 3] - command) ** 2,
        reference_error=(x[:, 3] - reference) ** 2,
        pitch=xp.abs(x[:, 2]),
        height=x[:, 1],
        height_min=x[:, 1],
        height_max=x[:, 1],
        slip=slip,
        torque=xp.abs(torque).max(axis=(1, 2)),
        saturated=at_limit.any(axis=(1, 2)) * one,
        saturated_joints=at_limit.mean(axis=1) * one[:, None],
    )


def of_run(run: Trajectory, slip: np.ndarray, limit: np.ndarray) -> TickStats:
    """Of an episode whose every step is there, each a tick of its own.

    Args:
      run: the episode.
      slip: (N - 1,) path of the feet from each step to the next [m].
      limit: (3,) torque limits [N m].
    """
    command, reference = run.velocity_command, run.velocity_reference
    return of_steps(run.x, np.append(slip, 0.0), run.torque, command, reference, limit)


def empty_stats(ticks: int, robots: int, dtype: Any) -> TickStats:
    """Zeros for stats of so many ticks and robots."""
    return TickStats(
        **{
            name: np.zeros(
                (ticks, robots, 3) if name == "saturated_joints" else (ticks, robots), dtype
            )
            for name in TickStats._fields
        }
    )


def empty_windows(model: mujoco.MjModel, robots: int, ticks: int, steps: int, dtype: Any) -> Window:
    """Zeros for the windows of some ticks, leading axes (robots, ticks)."""

    def zeros(rows: int, width: int) -> np.ndarray:
        return np.zeros((robots, ticks, rows, width), dtype)

    return Window(
        qpos=zeros(steps + 1, model.nq),
        qvel=zeros(steps + 1, model.nv),
        sensordata=zeros(steps + 1, model.nsensordata),
        torque=zeros(steps, model.nu),
    )


def build_read_window(
    base: Base, observe: Observe, at: Addresses, *, free: bool, dt: float
) -> ReadWindow:
    """Function (params, track, origin, window, command, reference) -> stats of one tick.

    ``command`` and ``reference`` are those of v_x in the tick [m/s].

    Args:
      base: that the robot walks on.
      observe: (qpos, qvel, sensordata) -> observation.
      at: addresses in the model.
      free: whether the base is free.
      dt: physics step [s].
    """
    legs = at.actuator.reshape(-1)

    def read(
        params: RobotParams,
        track: Any,
        origin: Array,
        window: Window,
        command: Array,
        reference: Array,
    ) -> TickStats:
        seen = jax.vmap(observe)(window.qpos, window.qvel, window.sensordata)
        seen = seen._replace(base_pos=seen.base_pos - origin.astype(seen.base_pos.dtype))
        pressed = seen.contact[:-1] & seen.contact[1:]
        if free:
            seen = jax.tree.map(lambda a: a[:-1], seen)
        view: View = jax.vmap(lambda one: base.view(params, track, one))(seen)
        if free:
            sliding = jax.vmap(sole_speed, in_axes=(None, 0, 0, 0, 0))(
                params,
                seen.base_quat,
                jnp.concatenate([seen.base_vel, seen.base_ang_vel], axis=1),
                seen.joint_pos,
                seen.joint_vel,
            )
        else:
            # The foot is a sphere that rolls as the calf turns, with nose-down positive rates.
            turning = seen.base_ang_vel[:, None, 1] + seen.joint_vel[:, :, 1:].sum(axis=-1)
            sole = view.feet_vel[:, :, 0] - params.foot_radius * turning
            sliding = jnp.abs(sole)[1:]  # a step moves with the velocity that it ends in
        steps = of_steps(
            view.planar.x[: len(pressed)],
            dt * jnp.where(pressed, sliding, 0.0).sum(axis=1),
            window.torque[:, legs].reshape(-1, 4, 3),
            command,
            reference,
            jnp.asarray(params.torque_limit),
            jnp,
        )
        return _of_tick(steps)

    return read


def _of_tick(steps: TickStats) -> TickStats:
    """One tick's statistics from those of its steps, zeros where one is not finite."""
    finite = jnp.stack([jnp.isfinite(a).all() for a in steps]).all()
    tick = TickStats(
        **{
            name: getattr(jnp, _EXTREMES.get(name, "sum"))(value, axis=0)
            for name, value in steps._asdict().items()
        }
    )
    return TickStats(*(jnp.where(finite, value, 0.0) for value in tick))
