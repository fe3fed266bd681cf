"""One robot's episode as arrays, and the planar states that it went through."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kjax.legs.base import build_base
from kjax.sim import free_base
from kjax.sim.observe import Observe
from kjax.types import RobotParams


@dataclass(kw_only=True)
class Trajectory:
    """One robot's episode; arrays (N,) at the physics rate, from a batch at the control rate.

    Attributes:
      dt: time between two samples [s].
      time: [s].
      qpos: (N, nq) positions of the model.
      qvel: (N, nv) velocities of the model.
      x: (N, 6) true SRB state of the whole-body centre of mass, from the start on the floor
        [m, rad, m/s, rad/s].
      feet: (N, 4, 2) foot centres (x, z), likewise, in the plane of a free base's heading [m].
      foot_force: (N, 4) normal force on the contact sensors [N].
      torque: (N, 4, 3) joint torques commanded (abduction, thigh, calf) [N m].
      gait: (N,) index of the gait, order of ``ControllerParams.schedule``.
      stance: (N, 4) scheduled stance.
      force: (N, 4, 3) planned force of each leg on the robot, world axes, turned by the heading
        at the start [N].
      velocity_command: (N,) [m/s].
      velocity_reference: (N,) what the LMPC tracks: the command at a bounded rate [m/s].
      body_contact: (P,) whether anything but a foot touches the world at a control tick; from a
        batch (0,).
      plan_status: (P,) ``qp.Status`` of each plan.
      plan_residual: (P,) KKT residual [-].
      plan_iterations: (P,) solver iterations.
      plan_time: (P,) wall time of each call [s]; from a batch (0,).
      act_time: (N,) wall time of each call [s]; from a batch (0,).
      wall_time: of the whole loop [s]; from a batch the time of all of it.
      fell: whether the robot fell (the episode ends there).
      interrupted: whether the user stopped the run.
    """

    dt: float
    time: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    x: np.ndarray
    feet: np.ndarray
    foot_force: np.ndarray
    torque: np.ndarray
    gait: np.ndarray
    stance: np.ndarray
    force: np.ndarray
    velocity_command: np.ndarray
    velocity_reference: np.ndarray
    body_contact: np.ndarray
    plan_status: np.ndarray
    plan_residual: np.ndarray
    plan_iterations: np.ndarray
    plan_time: np.ndarray
    act_time: np.ndarray
    wall_time: float
    fell: bool
    interrupted: bool

    def save(self, path: Path) -> None:
        """Write everything to a compressed ``.npz``."""
        np.savez_compressed(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "Trajectory":
        """Read what ``save`` wrote."""
        with np.load(path) as data:
            values: dict[str, Any] = {f.name: data[f.name] for f in fields(cls)}
        for name, kind in (
            ("dt", float),
            ("wall_time", float),
            ("fell", bool),
            ("interrupted", bool),
        ):
            values[name] = kind(values[name])
        return cls(**values)


def sagittal(
    robot: RobotParams,
    observe: Observe,
    qpos: np.ndarray,
    qvel: np.ndarray,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """True SRB states (N, 6) and feet (N, 4, 2) along a trajectory, without noise.

    Of a free base: in the plane of its heading, with the progress along the heading at the start.

    Args:
      robot: geometry and masses.
      observe: of the model.
      qpos: (N, nq) positions.
      qvel: (N, nv) velocities.
      start: (3,) point that positions are measured from, the world's origin if ``None`` [m].
    """
    zero = jnp.zeros(3) if start is None else jnp.asarray(start)
    base = build_base("free" if free_base.is_free(qpos) else "planar")
    track = base.track(observe(jnp.asarray(qpos[0]), jnp.asarray(qvel[0]), jnp.zeros(64)))

    def one(qpos: jax.Array, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = observe(qpos, qvel, jnp.zeros(64))
        seen = seen._replace(base_pos=seen.base_pos - zero)
        body = base.view(robot, track, seen).planar
        return body.x, body.feet

    x, feet = jax.jit(jax.vmap(one))(qpos, qvel)
    return np.asarray(x), np.asarray(feet)
