import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kjax.config import RunConfig, SimConfig
from kjax.legs.kinematics import foot_jacobian, foot_position, leg_trig
from kjax.legs.stance import stance_torque
from kjax.robots import go1
from kjax.sim.resolve import build_scene
from kjax.tuning import plant

PLANT = plant.nominal_plant(go1.PARAMS, 12.7, 0.39)
X = jnp.array([0.3, 0.27, 0.1, 0.4, -0.2, 0.5])
FEET = jnp.array([[0.5, 0.02], [0.46, 0.02], [0.12, 0.02], [0.08, 0.02]])


def test_on_its_legs_the_body_moves_as_newton_and_euler_say():
    stance = jnp.array([True, False, True, True])
    force = jnp.array([[10.0, 80.0], [5.0, 99.0], [-20.0, 30.0], [-10.0, 60.0]])

    def rate(_, x):
        c, s = np.cos(x[2]), np.sin(x[2])
        total, moment = np.zeros(2), 0.0
        for leg in (0, 2, 3):
            fx = c * force[leg, 0] - s * force[leg, 1]
            fz = s * force[leg, 0] + c * force[leg, 1]
            rx, rz = FEET[leg, 0] - x[0], FEET[leg, 1] - x[1]
            total += np.array([fx, fz])
            moment += rx * fz - rz * fx
        return [*x[3:], total[0] / 12.7, total[1] / 12.7 - 9.81, moment / 0.39]

    wanted = solve_ivp(rate, (0, 0.001), X, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    next_state = plant.advance(PLANT, stance, X, FEET, force, 0.001)
    # One Runge-Kutta step: 1.4e-8 at 5 ms, of fifth order.
    np.testing.assert_allclose(next_state, wanted, rtol=0, atol=1e-11)


def test_the_view_puts_trunk_and_feet_where_the_body_says():
    seen = plant.view(go1.PARAMS, PLANT.com, X, FEET).planar
    np.testing.assert_allclose(seen.base + seen.rotation @ PLANT.com, X[:2], atol=1e-15)

    def base(t):
        x = X + t * jnp.concatenate([X[3:], jnp.zeros(3)])
        return plant.view(go1.PARAMS, PLANT.com, x, FEET).planar.base

    _, velocity = jax.jvp(base, (0.0,), (1.0,))
    np.testing.assert_allclose(seen.base_vel, velocity, atol=1e-12)


def test_forces_that_joints_and_ground_can_give_pass_unchanged():
    body = plant.view(go1.PARAMS, PLANT.com, X, FEET).planar
    force = jnp.tile(jnp.array([3.0, 30.0]), (4, 1))
    np.testing.assert_allclose(plant.feasible(go1.PARAMS, PLANT, body, force), force, rtol=1e-12)


def test_the_legs_angular_momentum_is_mujocos():
    """Planar Go1, trunk at rest or moving, legs swinging: MuJoCo's less the trunk's own share."""
    model = build_scene(RunConfig(sim=SimConfig()))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for trial in range(5):
        joints = np.tile([0.0, 0.9, -1.8], (4, 1)) + [0, 1, 1] * rng.uniform(-0.4, 0.4, (4, 3))
        rates = rng.normal(size=(4, 3)) * [0.0, 6.0, 8.0]
        data.qpos[-12:], data.qvel[:] = joints.reshape(-1), 0.0
        data.qvel[-12:] = rates.reshape(-1)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        wanted = -data.subtree_angmom[0][1]  # nose down in MuJoCo
        trig = leg_trig(jnp.asarray(joints))
        base = data.body("trunk").xpos[::2]
        com = jnp.asarray(data.subtree_com[0][::2] - base)
        feet = foot_position(go1.PARAMS, trig) + go1.PARAMS.hip_pos[:, ::2]
        x = jnp.array([*(com + base), 0.0, *rng.normal(size=2), 0.0])
        here = PLANT._replace(com=com)
        body = plant.view(go1.PARAMS, com, x, feet + base).planar
        J = foot_jacobian(go1.PARAMS, trig)
        velocity = jnp.einsum("nij,nj->ni", J, jnp.asarray(rates[:, 1:])) + x[3:5]
        got = plant.leg_momentum(go1.PARAMS, here, body, feet + base, velocity)
        assert abs(wanted) > 0.05, trial
        np.testing.assert_allclose(got, wanted, rtol=1e-3)  # inertias to four digits


def test_a_part_of_a_force_may_be_lost():
    body = plant.view(go1.PARAMS, PLANT.com, X, FEET).planar
    force = jnp.tile(jnp.array([3.0, 30.0]), (4, 1))
    weak = PLANT._replace(gain=jnp.asarray(0.9))
    np.testing.assert_allclose(plant.feasible(go1.PARAMS, weak, body, force), 0.9 * force)


@pytest.mark.parametrize(
    "force", [[300.0, 100.0], [-300.0, 20.0], [0.0, 2000.0], [0.0, -50.0]], ids=str
)
def test_forces_beyond_friction_torque_or_a_pull_are_cut(force):
    body = plant.view(go1.PARAMS, PLANT.com, X, FEET).planar
    kept = plant.feasible(go1.PARAMS, PLANT, body, jnp.tile(jnp.array(force), (4, 1)))
    world = np.asarray(kept @ body.rotation.T)
    assert (world[:, 1] >= -1e-12).all()
    assert (np.abs(world[:, 0]) <= 0.8 * world[:, 1] + 1e-9).all()
    assert np.abs(kept - np.array(force)).max() > 1.0
    torque = np.abs(stance_torque(go1.PARAMS, body.trig, kept))
    assert (torque <= np.asarray(go1.PARAMS.torque_limit[1:]) * (1 + 1e-9)).all()


def test_a_force_follows_the_planned_one_as_a_first_order_lag_does():
    slow = PLANT._replace(lag=jnp.asarray(0.004))
    before, planned = jnp.array([[0.0, 0.0]] * 4), jnp.array([[8.0, 100.0]] * 4)
    times = np.linspace(0.0, 0.005, 20001)
    wanted = 100.0 * np.trapezoid(1.0 - np.exp(-times / 0.004), times) / 0.005
    mean, end = plant.follow(slow, before, planned, 0.005)
    np.testing.assert_allclose(mean[:, 1], wanted, rtol=1e-8)
    np.testing.assert_allclose(mean[:, 0], 0.08 * wanted, rtol=1e-8)
    np.testing.assert_allclose(end, planned * (1.0 - np.exp(-0.005 / 0.004)), rtol=1e-12)
    np.testing.assert_allclose(plant.follow(PLANT, before, planned, 0.005)[0], planned, rtol=2e-3)
