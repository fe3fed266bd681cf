"""Rigid-body models that others predict with, as a ``Response``: to compare with.

``convex``: Di Carlo et al., Dynamic Locomotion in the MIT Cheetah 3 Through Convex Model-Predictive
Control (2018). Small roll and pitch, no gyroscopic term, levers from the reference's path:

    Theta' = Rz(psi)^T omega,   omega' = (Rz I Rz^T)^-1 sum (r_i - p_ref) x F_i

``present``: the rigid body linearised in state and forces where the robot is, held over the
horizon.

``edmd``, ``bilinear``: learned ones, see ``mpc.learned_models``. ``residual``: the momentum form
with what was learned from the whole robot, see ``mpc.residual_model``.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.dynamics import rotations, srb_spatial
from kjax.dynamics.rotations import skew
from kjax.dynamics.srb_spatial import BodyState
from kjax.mpc import learned_models, residual_model
from kjax.mpc.momentum import linearise
from kjax.mpc.response import STATE, Prediction, PredictionTask, Response


def convex(task: PredictionTask) -> Response:
    """Di Carlo's model, levers and yaw of the targets."""
    body, start, length, feet, nominal, targets, *_ = task
    heading = targets.heading
    zero = jnp.zeros_like(heading[:, 0])
    Rz = jnp.stack(
        [
            jnp.stack([heading[:, 0], -heading[:, 1], zero], axis=-1),
            jnp.stack([heading[:, 1], heading[:, 0], zero], axis=-1),
            jnp.stack([zero, zero, zero + 1.0], axis=-1),
        ],
        axis=-2,
    )
    W = Rz @ rotations.inverse(body.inertia)[None] @ jnp.swapaxes(Rz, 1, 2)
    before = jnp.concatenate([targets.p[:1] - length[0] * targets.v[:1], targets.p[:-1]])
    middle = 0.5 * (before + targets.p)
    levers = skew(feet - middle[:, None])  # (K, 4, 3, 3)
    h = length[:, None, None]
    eye = jnp.eye(3, dtype=start.p.dtype)
    turning = jnp.einsum("kij,kljm->klim", W, levers)
    A = jnp.broadcast_to(jnp.eye(STATE, dtype=start.p.dtype), (len(length), STATE, STATE))
    A = A.at[:, :3, 6:9].set(h * eye[None]).at[:, 3:6, 9:].set(h * eye[None])
    push = jnp.broadcast_to(eye / body.mass, turning.shape)
    h = h[..., None]
    B = jnp.concatenate([h**2 / 2 * turning, h**2 / 2 * push, h * turning, h * push], axis=2)

    omega = srb_spatial.angular_velocity(body, start.R, start.L)
    x = jnp.concatenate([_roll_pitch_yaw(start.R), start.p, omega, start.v])
    fall = jnp.zeros_like(x).at[5].set(1.0).at[11].set(1.0)

    def node(x: Array, now: tuple[Array, ...]) -> tuple[Array, Array]:
        A, B, Rz, force, h = now
        time = jnp.where(jnp.arange(STATE) < 6, h**2 / 2, h)
        pull = srb_spatial.gravity(x.dtype)[2] * fall * time
        drift = jnp.einsum("lsf,lf->s", B, force)
        # The angles turn with the rate in the axes of the heading.
        step = (A - jnp.eye(STATE, dtype=x.dtype)) @ x + drift + pull
        x = x + step.at[:3].set(Rz.T @ step[:3])
        return x, x

    _, xs = jax.lax.scan(node, x, (A, B, Rz, nominal, length))
    R = _from_angles(xs[:, :3])
    L = jnp.einsum("kij,jl,kml,km->ki", Rz, body.inertia, Rz, xs[:, 6:9])
    states = BodyState(p=xs[:, 3:6], R=R, v=xs[:, 9:], L=L)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    outputs = jnp.broadcast_to(jnp.eye(STATE, dtype=x.dtype), A.shape)
    return Response(states, xs[:, 6:9], A, B, outputs)


def present(task: PredictionTask) -> Response:
    """Linearised at the present state and forces."""
    body, start, length, feet, nominal, *_ = task
    eye = jnp.eye(3, dtype=start.p.dtype)
    omega = srb_spatial.angular_velocity(body, start.R, start.L)

    def slope(y: Array, force: Array, feet: Array) -> Array:
        """Change of y = (turn since now, place, angular velocity, velocity) in time."""
        d, p, w, v = y.reshape(4, 3)
        R = rotations.exp(d) @ start.R
        inertia = R @ body.inertia @ R.T
        moment = jnp.cross(feet - p[None], force).sum(axis=0) - jnp.cross(w, inertia @ w)
        d_rate = w - jnp.cross(d, w) / 2 + jnp.cross(d, jnp.cross(d, w)) / 12
        rate = R @ rotations.inverse(body.inertia) @ R.T @ moment
        fall = srb_spatial.gravity(p.dtype) + force.sum(axis=0) / body.mass
        return jnp.concatenate([d_rate, v, rate, fall])

    y0 = jnp.concatenate([jnp.zeros_like(start.p), start.p, omega, start.v])
    Ac = jax.jacfwd(slope)(y0, nominal[0], feet[0])
    W = start.R @ rotations.inverse(body.inertia) @ start.R.T

    def node(y: Array, now: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        force, feet, h = now
        levers = jnp.einsum("ij,ljm->lim", W, skew(feet - start.p[None]))
        none = jnp.zeros_like(levers)
        push = none + eye[None] / body.mass
        Bc = jnp.concatenate([none, none, levers, push], axis=1)
        hA = h * Ac
        series = jnp.eye(STATE, dtype=y.dtype)
        whole = series
        for k in (5, 4, 3, 2):
            whole = series + hA @ whole / k
        A = series + hA @ whole
        B = h * jnp.einsum("ij,ljf->lif", whole, Bc)
        slope0 = slope(y0, jnp.zeros_like(force), feet)
        constant = slope0 - Ac @ y0
        new = A @ y + h * whole @ constant + jnp.einsum("lsf,lf->s", B, force)
        return new, (new, A, B)

    _, (ys, A, B) = jax.lax.scan(node, y0, (nominal, feet, length))
    d = ys[:, :3]
    R = rotations.exp(d) @ start.R[None]
    inertia = R @ body.inertia[None] @ jnp.swapaxes(R, 1, 2)
    # A change of the turn since now is one of the nominal attitude.
    L = jnp.einsum("kij,kj->ki", inertia, ys[:, 6:9])
    states = BodyState(p=ys[:, 3:6], R=R, v=ys[:, 9:], L=L)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    K = skew(d)
    outputs = jnp.broadcast_to(jnp.eye(STATE, dtype=d.dtype), A.shape)
    outputs = outputs.at[:, :3, :3].set(eye[None] + K / 2 + K @ K / 6)
    return Response(states, ys[:, 6:9], A, B, outputs)


def _roll_pitch_yaw(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Angles of R = Rz(yaw) Ry(pitch) Rx(roll) [rad]; here nose down is positive."""
    level = jnp.sqrt(R[0, 0] ** 2 + R[1, 0] ** 2)
    return jnp.stack(
        [
            jnp.arctan2(R[2, 1], R[2, 2]),
            jnp.arctan2(-R[2, 0], level),
            jnp.arctan2(R[1, 0], R[0, 0]),
        ]
    )


def _from_angles(angles: Float[Array, "K 3"]) -> Float[Array, "K 3 3"]:
    """R of roll, pitch and yaw."""

    def about(axis: int) -> Array:
        return rotations.exp(jnp.zeros_like(angles).at[:, axis].set(angles[:, axis]))

    return about(2) @ about(1) @ about(0)


def _momentum(task: PredictionTask) -> Response:
    """``momentum.linearise``, which needs no targets."""
    return linearise(task.body, task.start, task.length, task.feet, task.nominal)


PREDICTIONS: dict[str, Prediction] = {
    "momentum": _momentum,
    "convex": convex,
    "present": present,
    "edmd": learned_models.edmd,
    "bilinear": learned_models.bilinear,
    "residual": residual_model.residual,
}
