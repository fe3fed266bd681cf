"""From parameters to tables: one way inside and outside ``jit``, with derivatives by weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, build_controller, condense, load_config, resolve
from kjax.controllers.params import with_params
from kjax.legs.posture import stand_pose, standing
from kjax.robots import go1


@pytest.fixture(scope="module")
def both():
    """Spec and parameters of a trot on the planar base."""
    return resolve(load_config(RunConfig, None, {"sim.base": "planar"}), go1.PARAMS)


def test_a_users_float32_gets_tables_that_were_made_in_float64(both):
    spec, params = both
    double = condense(spec, params, dtype=np.float64)
    with jax.enable_x64(False):
        single = condense(spec, params)
    assert single.lmpc.F.dtype == single.params.height.dtype == np.float32
    np.testing.assert_array_equal(single.lmpc.F, np.float32(double.lmpc.F))
    np.testing.assert_array_equal(single.lmpc.hessian.H, np.float32(double.lmpc.hessian.H))


def test_traced_numbers_give_the_same_tables(both):
    spec, params = both
    eager = condense(spec, params)
    traced = jax.jit(lambda params: condense(spec, params))(params)
    inside = jax.jit(lambda: condense(spec, params))()
    for other in (traced, inside):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12),
            eager.lmpc,
            other.lmpc,
        )


def test_a_plan_has_a_derivative_by_a_weight(both):
    """Against central differences; away from bounds the plan is smooth."""
    spec, params = both
    controller = build_controller(spec)
    seen = standing(jnp.asarray(stand_pose(go1.PARAMS, 0.27)[1]))._replace(
        base_vel=jnp.array([0.1, 0.0, 0.0])
    )

    def force(weight):
        Q = jnp.asarray(params.modes.state_weights).at[0, 3].set(weight)
        tables = condense(spec, params._replace(modes=params.modes._replace(state_weights=Q)))
        state, _ = controller.plan(tables, controller.init(tables, seen), seen)
        return state.force[:, 0].sum()

    weight = float(params.modes.state_weights[0, 3])
    force = jax.jit(force)
    slope = jax.grad(force)(weight)
    step = 1e-3 * weight
    difference = (force(weight + step) - force(weight - step)) / (2.0 * step)
    assert abs(slope) > 1e-2
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


def test_numbers_that_are_condensed_already_are_not_replaced_in_tables(both):
    spec, params = both
    tables = condense(spec, params)
    higher = with_params(tables, height=tables.params.height + 0.01)
    assert higher.params.height[0] > tables.params.height[0]
    assert (
        with_params(tables, height=np.full(3, 0.25)).params.height.dtype
        == tables.params.height.dtype
    )
    with pytest.raises(ValueError, match=r"modes: the tables are condensed from it; use condense"):
        with_params(tables, modes=params.modes)


def test_what_belongs_elsewhere_is_named(both):
    spec, params = both
    with pytest.raises(TypeError, match=r"wanted condense\(spec, params\), got ControllerParams"):
        build_controller(spec).init(params, standing())
    with pytest.raises(TypeError, match=r"spec: wanted that of kjax\.resolve, got RunConfig"):
        build_controller(RunConfig())
    with pytest.raises(TypeError, match=r"params: wanted those of kjax\.resolve, got RunConfig"):
        condense(spec, RunConfig())


def scaled(robot, scale):
    """The robot with all lengths times ``scale``, of the same density."""
    powers = {"mass": 3, "trunk_mass": 3, "link_mass": 3, "inertia": 5, "torque_limit": 4,
              "joint_inertia": 5, "knee": 0}  # fmt: skip
    return robot._replace(
        **{name: leaf * scale ** powers.get(name, 1) for name, leaf in robot._asdict().items()}
    )


@pytest.mark.parametrize("scale", [0.7, 1.6])
def test_a_robot_scaled_in_size_and_mass_gets_params_scaled_by_dimensional_analysis(scale):
    """Lengths by s, masses by s^3, and with g the same, times by sqrt(s)."""
    base = resolve(RunConfig(), go1.PARAMS)[1]
    large = resolve(RunConfig(), scaled(go1.PARAMS, scale))[1]
    force, length, time = scale**3, scale, scale**0.5
    for get, factor in (
        (lambda p: p.modes.upper, force),
        (lambda p: p.modes.input_reference, force),
        (lambda p: p.modes.input_weights, force**-2),
        (
            lambda p: p.modes.state_weights,
            np.array([length**-2] * 2 + [1.0] + [time**2 / length**2] * 2 + [time**2]),
        ),
        (lambda p: p.height, length),
        (lambda p: p.swing.apex, length),
        (lambda p: p.swing.offset, length),
        (lambda p: p.swing.velocity_gain, time),
        (lambda p: p.swing.kp, force * length),
        (lambda p: p.swing.kd, force * length * time),
        (lambda p: p.blind_damping, force * length * time),
        (lambda p: p.lateral.roll, np.array([force * length, force * length * time])),
        (lambda p: p.lateral.yaw, np.array([force * length, force * length * time])),
        (lambda p: p.lateral.damping, force * time / length),
        (lambda p: p.lateral.weights, np.array([1.0] * 3 + [length**-2] * 3)),
        (lambda p: p.lateral.foothold_gain, time),
        (lambda p: p.fits.feet, length),
    ):
        np.testing.assert_allclose(get(large), get(base) * factor, rtol=1e-6, atol=1e-9)
