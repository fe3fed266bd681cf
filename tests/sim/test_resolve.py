"""A batch as data: what is left out of its common part must not reach the compiled functions."""

import typing

import jax
import numpy as np
import pytest

from kjax.config import ConfigError, RunConfig, fields, load_config
from kjax.controllers.params import condense
from kjax.controllers.resolve import resolve
from kjax.robots import go1
from kjax.sim.batching import stack_tables
from kjax.sim.closed_loop import Sensed, build_closed_loop
from kjax.sim.episode import push_at, stack_params
from kjax.sim.resolve import batch_spec, build_scene, resolve_episodes, resolve_scene

# Where 0.9 times the default, or the next of a list of words, is no value.
VALUES = {
    "robot": "toy_robot:ROBOT",
    "koopman.model": "srb",
    "srb.mass": 11.0,
    "srb.inertia": 0.3,
    "srb.feet_front": [0.2, -0.25],
    "srb.feet_rear": [-0.2, -0.25],
    "gait.names": ["bound"],
    "command.height": [0.0, 0.01, 0.0, 0.0, 0.0],
    "gaits.bound.duty": [0.29, 0.29, 0.15, 0.15],
    "gait.also": ["trot", "bound", "stand", "walk"],
    **{
        f"gaits.{gait}.{key}": value
        for gait in ("trot", "bound")
        for key, value in {
            "transition_gait": "stand",
            "switch_rule": "cycle_end",
            "body_height": 0.657,
            "Q": [181.0, 3630.0, 1000.0, 42.0, 8.4, 2.3],
            "R": 0.03,
            "grf_x_max": 0.44,
            "grf_z_min": 0.08,
            "grf_z_max": 2.3,
            "foothold_gain": 0.24,
            "swing_height": 0.164,
            "attitude": [20.0, 10.0, 15.0],
            "position": [0.5, 0.5, 5.0],
            "omega": [1.0, 2.0, 3.0],
            "velocity": [3.0, 4.0, 2.0],
            "force": 0.1,
        }.items()
    },
    "lmpc.control_dt": 0.01,
    "lmpc.model_dt": 0.002,
    "leg.act_dt": 0.005,
    "sim.sim_dt": 0.0005,
    "sim.delay": 0.01,
    "push.duration": 0.05,
    "terrain.slope": -5.0,
    "koopman.dataset.dt": 0.0005,
    "koopman.dataset.force_z": [0.0, 140.0],
    "multiphase.max_iterations": 40,
}
# What a controller or a scene is compiled for.
STATIC = {
    "robot", "controller",
    "lmpc.control_dt", "lmpc.model_dt", "lmpc.horizon", "lmpc.uncertainty_discount", "lmpc.solver",
    "lmpc.warm_start", "lmpc.tolerance", "lmpc.max_iterations", "leg.act_dt",
    "koopman.model", "koopman.dictionary", "koopman.order", "koopman.fourier_count",
    "koopman.fourier_scale", "koopman.fourier_seed", "koopman.constant_rotation", "koopman.feet",
    "koopman.dataset.dt",
    # Which phases a gait has, and how many cycles its flights grow over.
    "gait.also", "gaits.trot.offset", "gaits.trot.duty", "gaits.trot.ramp_cycles",
    "gaits.bound.ramp_cycles", "gaits.bound.horizon",
    "sim.sim_dt", "sim.base", "sim.cone", "sim.contacts", "sim.joint_damping",
    "sim.joint_armature", "sim.contact_threshold", "terrain.kind", "terrain.count",
    "noise.enabled", "noise.force",
}  # fmt: skip
# Likewise, of the spatial controller.
SPATIAL = {
    "spatial.model", "spatial.horizon", "spatial.node_dt", "spatial.tolerance",
    "spatial.max_iterations",
}  # fmt: skip
# What only means something beside other keys, needs a file, or is a list whose length counts.
LEFT_OUT = {
    "koopman.file", "spatial.file", "gait.times", "command.times", "push.times", "push.lateral",
    "command.v_y", "command.yaw_rate", "command.roll", "command.pitch",
    "gaits.trot.foothold_front", "gaits.trot.foothold_rear",
    "gaits.trot.reference", "gaits.trot.horizon",
}  # fmt: skip
# The gaits that are compiled unless a config says otherwise; the keys of the others are the same.
GAITS = ("gaits.trot.", "gaits.bound.")


def another(name, annotation, default):
    """Another valid value of a key."""
    if name in VALUES:
        return VALUES[name]
    if typing.get_origin(annotation) is typing.Literal:
        return next(one for one in typing.get_args(annotation) if one != default)
    if isinstance(default, bool):
        return not default
    if isinstance(default, int):
        return default + 1
    if isinstance(default, tuple):
        return [0.9 * part for part in default]
    return 0.9 * default if default else 0.1


def keys():
    """Every key of a run with another value."""
    for name, info, default in fields(RunConfig):
        other = name.startswith("gaits.") and not name.startswith(GAITS)
        if name not in LEFT_OUT and not other:
            yield name, another(name, info.annotation, default)


def program(config):
    """What ``plan`` and ``act`` compute, as text."""
    model = build_scene(config, visual=False)
    spec = batch_spec(config)
    loop = build_closed_loop(go1.ROBOT, spec, model, held=False)
    tables = condense(*resolve(config, go1.PARAMS))
    # Pushes are the engine's.
    params = resolve_scene(config)[1]._replace(push_begin=(), push_steps=(), push_force=())
    sensed = Sensed(np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nsensordata))

    def walk(tables, params, step, sensed):
        noise = loop.noise(params, step)
        state = loop.init(tables, noise, sensed)
        state, log = loop.plan(tables, params.origin, state, noise, sensed)
        return loop.act(tables, state, noise, sensed), log

    return str(jax.make_jaxpr(walk)(tables, params, np.int32(0), sensed))


def test_every_key_either_makes_another_program_or_none():
    """A new key of the config belongs to the spec, or must not reach the compiled functions."""
    plain = batch_spec(RunConfig())
    changing = {
        name
        for name, value in keys()
        if batch_spec(load_config(RunConfig, None, {name: value})) != plain
    }
    assert changing == STATIC


@pytest.mark.parametrize("kind", ["planar", "free", "spatial"])
def test_what_a_batch_may_vary_changes_nothing_in_the_program(kind):
    spatial = kind == "spatial"
    own = {"sim.base": "free", "controller": kind} if spatial else {"sim.base": kind}
    fixed = STATIC | SPATIAL if spatial else STATIC
    varied = own | {name: value for name, value in keys() if name not in fixed}
    config, other = (load_config(RunConfig, None, chosen) for chosen in (own, varied))
    assert batch_spec(other) == batch_spec(config)
    assert hash(batch_spec(other)) == hash(batch_spec(config))
    assert program(other) == program(config)


def test_nodes_of_a_horizon_in_three_dimensions_make_another_program():
    own = {"sim.base": "free", "controller": "spatial"}
    values = {name: value for name, value in keys() if name in SPATIAL}
    plain = batch_spec(load_config(RunConfig, None, own))
    for name, value in values.items():
        value = 0.4 if name == "spatial.horizon" else value
        assert batch_spec(load_config(RunConfig, None, own | {name: value})) != plain


def test_nodes_of_a_cycle_make_another_program():
    cycle = {"gait.names": ["bound_multiphase"]}
    specs = [
        batch_spec(load_config(RunConfig, None, cycle | own))
        for own in ({}, {"multiphase.node_dt": 0.025}, {"multiphase.tolerance": 1e-7},
                    {"multiphase.linearise": "last_plan"})
    ]  # fmt: skip
    assert len(set(specs)) == 4
    data = {"multiphase.friction": 0.5, "gaits.bound_multiphase.body_height": 0.6573}
    assert specs[0] == batch_spec(load_config(RunConfig, None, cycle | data))


def test_pushes_of_a_batch_are_filled_up_with_none():
    configs = [
        load_config(RunConfig, None, {"push.times": times, "push.forward": 3.0})
        for times in ([0.01], [0.02, 0.05], [])
    ]
    stacked = stack_params(resolve_episodes(configs))
    for step in range(300):
        # 3 N s in 0.1 s each, alone or together.
        began = [[0.01], [0.02, 0.05], []]
        wanted = [30.0 * sum(t <= step * 1e-3 + 1e-9 < t + 0.1 for t in ts) for ts in began]
        np.testing.assert_allclose(push_at(stacked, step)[:, 0], wanted, atol=1e-12)
    # over a control tick: the mean, so that the impulse stays
    held = sum(push_at(stacked, step, 5) * 5e-3 for step in range(0, 300, 5))
    np.testing.assert_allclose(held[:, 0], [3.0, 6.0, 0.0], rtol=1e-12)


def test_parameters_of_a_batch_are_those_of_its_robots():
    configs = [
        load_config(RunConfig, None, overrides)
        for overrides in (
            {"command.times": [0.0], "command.v_x": [0.4]},
            {"lmpc.body_height": 0.5869, "command.times": [0.0, 1.0], "command.v_x": [0.1, 0.2]},
            {"gait.names": ["trot", "bound"], "gait.times": [0.0, 2.0]},
        )
    ]
    tables, axes = stack_tables(resolve_episodes(configs), np.float64)
    assert axes.params.height == 0
    assert axes.params.swing.kp is None  # alike for all, so held once
    for i, config in enumerate(configs):
        own = condense(*resolve(config, go1.PARAMS))
        for of in (
            lambda one: one.params.height,
            lambda one: one.params.swing,
            lambda one: one.lmpc,
        ):
            jax.tree.map(
                lambda axis, leaf, want, i=i: np.testing.assert_array_equal(
                    leaf if axis is None else leaf[i], want
                ),
                of(axes),
                of(tables),
                of(own),
                is_leaf=lambda a: a is None,
            )
        count, params = len(config.command.times), tables.params
        np.testing.assert_array_equal(params.command.times[i, :count], config.command.times)
        assert np.isinf(params.command.times[i, count:]).all()
        assert params.gaits[i, 0] == own.params.gaits[0]
        assert params.gait_times.shape == (3, 2)


def test_a_delay_that_no_step_holds_is_refused():
    with pytest.raises(ConfigError, match=r"sim\.delay"):
        load_config(RunConfig, None, {"sim.delay": 0.0015})
