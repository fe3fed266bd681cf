"""One interface for every prediction model: lift, step, roll out, linearise.

A *family* is a kind of model as pure functions of its parameters; these are data, stacked over
contact modes. Every lifted state z begins with the constant 1 and the state x itself, so that an
affine model is a linear one and the state is read off. The LMPC takes any family: at each tick it
linearises it where the robot is (``operating_point``), which for a linear family changes nothing.

    family        z                        one step
    linear        [1, x, Pi(x)]            A z + B(r) u               the paper (EDMD)
    srb_hover     [1, x]                   A z + B(r) u               linearised, level and hovering
    bilinear      [1, x, Pi(x)]            A z + sum_i z_i B_i u
    srb           [1, x]                   the rigid body itself, feet fixed in the body
    planted       [1, x]                   the same with feet that stay on the ground
    exact         [1, x]                   planted, forces in the frame of the start: bilinear
    residual      [1, x, (u-, harmonics)]  planted + W phi(x, u, u-, harmonics)
    learned       [1, x, MLP(x)]           A z + sum_i z_i B_i u      (``learned``)
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from kjax.dynamics import srb_planar
from kjax.koopman.models import BilinearModel, LinearModel, aggregate, input_map
from kjax.koopman.observables import STATE_ROWS, Dictionary, states_only
from kjax.precision import full_precision
from kjax.types import GRAVITY, STATE_DIM


class Start(NamedTuple):
    """Where a prediction begins.

    Attributes:
      x: (6,) state [m, rad, m/s, rad/s].
      feet: (2, 2) contact points (front, rear) from the centre of mass, body frame [m].
      u_before: (4,) force of the same legs in the step before; 0 if ``None`` [N].
      stance_phase: 0 at the beginning of the stance and pi at its end [rad].
      stance_phase_rate: its change [rad/s].
    """

    x: Float[Array, "6"]
    feet: Float[Array, "2 2"]
    u_before: Float[Array, "4"] | None = None
    stance_phase: Float[Array, ""] | float = 0.0
    stance_phase_rate: Float[Array, ""] | float = 0.0


class Past(NamedTuple):
    """What a residual may remember besides the state.

    Attributes:
      u_before: (4,) force of the same legs in the step before [N].
      harmonics: (4,) of the stance phase, ``phase_harmonics``.
    """

    u_before: Float[Array, "4"]
    harmonics: Float[Array, "4"]


class BodyModel(NamedTuple):
    """Parameters of the families that know the rigid body.

    Attributes:
      body: mass, inertia, nominal contact points.
      alpha: (2,) stance legs at front and rear.
    """

    body: srb_planar.SrbParams
    alpha: Float[Array, "2"]


class ResidualModel(NamedTuple):
    """x+ = planted(x, u) + W phi.

    Attributes:
      nominal: parameters of the planted body.
      W: (6, F) weights of the features.
    """

    nominal: BodyModel
    W: Float[Array, "6 F"]


class Family(NamedTuple):
    """A kind of model; static, so close over it rather than passing it through ``jit``.

    Attributes:
      name: as configs call it.
      dt: one step [s].
      observables: names of the lifted state's entries.
      lift: (parameters, start) -> z (N,).
      step: (parameters, start, z, u) -> z one step later; u (4,) is the force per leg in the body
        frame, of which ``exact`` takes the one at the start.
    """

    name: str
    dt: float
    observables: tuple[str, ...]
    lift: Callable[[Any, Start], Float[Array, "N"]]
    step: Callable[[Any, Start, Float[Array, "N"], Float[Array, "4"]], Float[Array, "N"]]

    @property
    def size(self) -> int:
        """Number N of observables."""
        return len(self.observables)


def linear(dictionary: Dictionary, dt: float, name: str = "linear") -> Family:
    """Linear models in a dictionary's observables; parameters are a ``LinearModel``."""
    _require_one_state(dictionary)

    def step(params: LinearModel, start: Start, z: Array, u: Array) -> Array:
        return params.A @ z + input_map(params, start.feet) @ u

    return Family(name, dt, dictionary.names, lambda _, start: dictionary.lift(start.x), step)


def bilinear(dictionary: Dictionary, dt: float) -> Family:
    """Bilinear models in a dictionary's observables; parameters are a ``BilinearModel``."""
    _require_one_state(dictionary)

    def step(params: BilinearModel, start: Start, z: Array, u: Array) -> Array:
        return params.step(z, u, start.feet)

    return Family("bilinear", dt, dictionary.names, lambda _, start: dictionary.lift(start.x), step)


def _require_one_state(dictionary: Dictionary) -> None:
    if dictionary.window > 1:
        raise ValueError(
            f"dictionary looks at {dictionary.window} states (delay coordinates), a family takes "
            "one state: roll the model out from recorded motion with models.rollout"
        )


def rigid_body(dt: float) -> Family:
    """``srb``: the rigid body, contact points fixed in the body; parameters: ``BodyModel``."""

    def step(params: BodyModel, start: Start, z: Array, u: Array) -> Array:
        body = params.body._replace(feet=start.feet)
        return _with_one(srb_planar.rk4_step(body, params.alpha, z[STATE_ROWS], u, dt))

    return Family("srb", dt, states_only().names, _lift_state, step)


def planted(dt: float) -> Family:
    """``planted``: the rigid body on feet that stay where they are; parameters: ``BodyModel``."""

    def step(params: BodyModel, start: Start, z: Array, u: Array) -> Array:
        return _with_one(_planted_step(params, start, z[STATE_ROWS], u, dt))

    return Family("planted", dt, states_only().names, _lift_state, step)


def exact(dt: float) -> Family:
    """``exact``: the planted body under forces fixed in space, in closed form.

    With the force held and the feet on the ground, p and v are exactly linear in it,

        v+ = v + dt a,  p+ = p + dt v + dt^2/2 a,  a = sum F / m - g,

    and the moment of a moving centre of mass, M = (P - p(t)) x F with p(t) quadratic in t,
    integrates to polynomials: the step is bilinear in (1, x) and the force. ``u`` is the force in
    the frame that the body has at the start.
    """

    def step(params: BodyModel, start: Start, z: Array, u: Array) -> Array:
        x, m, inertia = z[STATE_ROWS], params.body.mass, params.body.inertia
        force = (params.alpha[:, None] * u.reshape(2, 2)) @ srb_planar.planar_rotation(start.x[2]).T
        total = force.sum(axis=0)
        accel = total / m - jnp.array([0.0, GRAVITY], x.dtype)
        p, v = x[:2], x[3:5]
        ground = srb_planar.contact_points(start.x, start.feet)
        arm = ground - p[None]
        moment = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]).sum()
        # M(t) = moment - t (v x F) - t^2/2 (a x F); a x F holds no F^2, as F x F = 0.
        v_cross_F = v[0] * total[1] - v[1] * total[0]
        a_cross_F = GRAVITY * total[0]
        omega = x[5] + (dt * moment - dt**2 / 2 * v_cross_F - dt**3 / 6 * a_cross_F) / inertia
        theta = x[2] + dt * x[5]
        theta += (dt**2 / 2 * moment - dt**3 / 6 * v_cross_F - dt**4 / 24 * a_cross_F) / inertia
        position = p + dt * v + 0.5 * dt**2 * accel
        return _with_one(jnp.concatenate([position, theta[None], v + dt * accel, omega[None]]))

    return Family("exact", dt, states_only().names, _lift_state, step)


def residual(
    dt: float,
    features: Callable[[Start, Array, Array, Past], Array],
    *,
    remembers: bool = True,
) -> Family:
    """``residual``: the planted body and what data adds to it; parameters: ``ResidualModel``.

    The lifted state holds the force of the step before, a delay coordinate, and the stance phase as
    four harmonics. These advance at a constant rate, which is linear: so a drift that changes
    along the stance, and a force that arrives late, stay in a model that is linearised only once.

    Args:
      dt: one step [s].
      features: (start, x, u, past) -> phi (F,); see ``koopman.features``.
      remembers: whether the features look at the past; else the lifted state is [1, x].
    """
    plain = states_only().names
    forces = tuple(f"last {name}" for name in ("F_x front", "F_z front", "F_x rear", "F_z rear"))
    names = (*plain, *forces, "sin phase", "cos phase", "sin 2 phase", "cos 2 phase")
    state, last = len(plain), len(plain) + len(forces)

    def lift(_: Any, start: Start) -> Array:
        one = _with_one(start.x)
        if not remembers:
            return one
        before = jnp.zeros((4,), one.dtype) if start.u_before is None else start.u_before
        return jnp.concatenate(
            [one, before, phase_harmonics(jnp.asarray(start.stance_phase, one.dtype))]
        )

    def step(params: ResidualModel, start: Start, z: Array, u: Array) -> Array:
        x = z[STATE_ROWS]
        past = Past(z[state:last], z[last:]) if remembers else Past(jnp.zeros(4), jnp.zeros(4))
        nominal = _planted_step(params.nominal, start, x, u, dt)
        next_state = _with_one(nominal + params.W @ features(start, x, u, past))
        if not remembers:
            return next_state
        single = _advanced(past.harmonics[:2], start.stance_phase_rate * dt)
        double = _advanced(past.harmonics[2:], 2 * start.stance_phase_rate * dt)
        return jnp.concatenate([next_state, u, single, double])

    return Family("residual", dt, names if remembers else plain, lift, step)


def phase_harmonics(stance_phase: Float[Array, "*V"]) -> Float[Array, "4 *V"]:
    """Sine and cosine of the stance phase (0 to pi) and of its double."""
    return jnp.stack(
        [
            jnp.sin(stance_phase),
            jnp.cos(stance_phase),
            jnp.sin(2 * stance_phase),
            jnp.cos(2 * stance_phase),
        ]
    )


def _advanced(harmonic: Float[Array, "2"], angle: Array | float) -> Float[Array, "2"]:
    """Sine and cosine of a phase that is further by an angle."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([harmonic[0] * c + harmonic[1] * s, harmonic[1] * c - harmonic[0] * s])


def affine_features(start: Start, x: Array, u: Array) -> Float[Array, "17"]:
    """Features of the affine residual: 1, theta, v, omega, u, contact points, their moments.

    The contact points are taken from the centre of mass, so that nothing depends on how far the
    robot has walked or how high the ground is.
    """
    arm = srb_planar.contact_points(start.x, start.feet) - x[None, :2]
    one = jnp.ones((1,), x.dtype)
    products = arm * u.reshape(2, 2)[:, ::-1]  # x F_z and z F_x of either end
    return jnp.concatenate([one, x[2:], u, arm.reshape(4), products.reshape(4)])


@full_precision
def rollout(
    family: Family, params: Any, start: Start, inputs: Float[Array, "steps 4"]
) -> Float[Array, "steps_plus_1 6"]:
    """Predicted states (steps + 1, 6); lifted once, at the start."""

    def one(z: Array, u: Array) -> tuple[Array, Array]:
        z = family.step(params, start, z, u)
        return z, z[STATE_ROWS]

    _, states = jax.lax.scan(one, family.lift(params, start), inputs)
    return jnp.concatenate([start.x[None], states])


def operating_point(
    family: Family, params: Any, start: Start, u: Float[Array, "4"], steps: int = 1
) -> LinearModel:
    """The model linearised at the start under the force ``u``, over ``steps`` of its steps at once.

    Exact for a linear family. What is left over by the linearisation goes to the column of the
    constant observable.
    """
    z = family.lift(params, start)
    value = family.step(params, start, z, u)
    A, B = jax.jacfwd(family.step, argnums=(2, 3))(params, start, z, u)
    A = A.at[:, 0].add(value - A @ z - B @ u)
    none = jnp.zeros((4, *B.shape), B.dtype)
    return aggregate(LinearModel(A=A, B=B, B_feet=none), steps)


def hover(
    body: srb_planar.SrbParams, alpha: Float[Array, "2"], feet: Float[Array, "2 2"] | None = None
) -> Float[Array, "4"]:
    """Force per leg (4,) that carries the weight: equal vertical forces of the stance legs [N]."""
    legs = jnp.maximum(alpha.sum(), 1.0)
    each = body.mass * GRAVITY / legs * (alpha > 0)
    return jnp.stack([jnp.zeros_like(each), each], axis=1).reshape(4)


def linearised_srb(
    body: srb_planar.SrbParams,
    alpha: Float[Array, "2"],
    height: Float[Array, ""] | float,
    dt: float,
) -> LinearModel:
    """Parameters of ``srb_hover``: the rigid body linearised level, at rest, carrying its weight.

    The moment is bilinear in contact point and force, so that the dependence of B on the contact
    points is exact.
    """
    family = rigid_body(dt)
    params = BodyModel(body, alpha)
    u = hover(body, alpha)
    x = jnp.zeros((STATE_DIM,), u.dtype).at[1].set(height)

    def at(feet: Array) -> LinearModel:
        return operating_point(family, params, Start(x, feet), u)

    here = at(jnp.zeros((2, 2), u.dtype))
    unit = jnp.eye(4, dtype=u.dtype).reshape(4, 2, 2)
    return here._replace(B_feet=jax.vmap(lambda feet: at(feet).B - here.B)(unit))


def _lift_state(_: Any, start: Start) -> Array:
    return _with_one(start.x)


def _with_one(x: Array) -> Array:
    return jnp.concatenate([jnp.ones((1,), x.dtype), x])


def _planted_step(params: BodyModel, start: Start, x: Array, u: Array, dt: float) -> Array:
    ground = srb_planar.contact_points(start.x, start.feet)
    return srb_planar.rk4(
        lambda x: srb_planar.planted_dynamics(params.body, params.alpha, ground, x, u), x, dt
    )
