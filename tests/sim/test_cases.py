"""A batch as data: what is left out of its common part must not reach the compiled functions."""

import dataclasses

import jax
import numpy as np
import pytest

from kjax.config import ConfigError, RunConfig, load_config
from kjax.params import build_params
from kjax.robots import go1
from kjax.sim import cases
from kjax.sim.observe import resolve
from kjax.sim.push import push_force
from kjax.sim.scene import build_model
from kjax.sim.walk import Sensed, build_walk


def other(value):
    """Another value of the same kind, in its range."""
    choices = {"mean": "zero", "periodic": "constant"}
    if isinstance(value, str):
        return choices[value]
    if isinstance(value, tuple):
        return tuple(map(other, value))
    if value is None:
        return 0.9
    return 0.9 * value if value else 0.1


def changed(config):
    """The config with everything else that a batch may vary."""
    varied = {"friction": 0.5, "payload": 1.0, "delay": 0.01, "floor": -2.0, "start": (3.0, 0.0)}
    sections = {
        "lmpc": {name: other(getattr(config.lmpc, name)) for name in cases._LMPC},
        "bound": {name: other(getattr(config.bound, name)) for name in cases._BOUND},
        "multiphase": {name: other(getattr(config.multiphase, name)) for name in cases._MULTIPHASE},
        "leg": {
            f.name: other(getattr(config.leg, f.name))
            for f in dataclasses.fields(config.leg)
            if f.name != "act_dt"  # shapes the program: a time step of the swings
        },
        "lateral": {
            f.name: other(getattr(config.lateral, f.name))
            for f in dataclasses.fields(config.lateral)
        },
        "srb": {
            "mass": 11.0,
            "inertia": 0.3,
            "feet_front": (0.2, -0.25),
            "feet_rear": (-0.2, -0.25),
        },
        "sim": varied,
        "gait": {"stance_time": 0.2, "switch_rule": "anywhere"},
    }
    new = {
        name: dataclasses.replace(getattr(config, name), **fields)
        for name, fields in sections.items()
    }
    return dataclasses.replace(config, seed=4, **new)


def program(config):
    """What ``plan`` and ``act`` compute, as text."""
    model = build_model(config.sim, visual=False)
    walk = build_walk(config, model, resolve(model).actuator, held=False)
    params = build_params(config, go1.PARAMS)
    case = jax.tree.map(lambda leaf: leaf[0], cases.stack_cases([config]))
    sensed = Sensed(np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nsensordata))
    state = jax.eval_shape(walk.init, params, case, sensed)
    step = np.int32(0)
    plan = jax.make_jaxpr(walk.plan)(params, case, state, step, sensed)
    act = jax.make_jaxpr(walk.act)(params, case, state, step, sensed)
    return str(plan), str(act)


@pytest.mark.parametrize("base", ["planar", "free"])
def test_what_a_batch_may_vary_changes_nothing_in_the_program(base):
    config = load_config(RunConfig, None, {"sim.base": base})
    varied = changed(config)
    assert cases.batch_part(varied) == cases.batch_part(config)
    assert program(varied) == program(config)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("lmpc.horizon", 8),
        ("lmpc.solver", "admm"),
        ("koopman.feet", "measured"),
        ("terrain.kind", "steps"),
        ("gait.trot_flight", 0.05),
        ("bound.ramp_cycles", 3),
        ("sim.sim_dt", 0.0005),
    ],
)
def test_what_is_compiled_in_makes_another_batch(key, value):
    varied = load_config(RunConfig, None, {key: value})
    assert cases.batch_part(varied) != cases.batch_part(RunConfig())


def test_pushes_are_those_of_a_single_run():
    configs = [
        load_config(RunConfig, None, {"push.times": times, "push.forward": 3.0})
        for times in ([0.01], [0.02, 0.05], [])
    ]
    stacked = cases.stack_cases(configs)
    for step in range(300):
        wanted = [push_force(c.push, np.array(step * 1e-3), 1e-3, np) for c in configs]
        np.testing.assert_allclose(cases.push_at(stacked, step), wanted, atol=1e-12)
    # over a control tick: the mean, so that the impulse stays
    held = sum(cases.push_at(stacked, step, 5) * 5e-3 for step in range(0, 300, 5))
    np.testing.assert_allclose(held[:, 0], [3.0, 6.0, 0.0], rtol=1e-12)


def test_parameters_of_a_batch_are_those_of_its_robots():
    configs = [
        load_config(RunConfig, None, overrides)
        for overrides in (
            {"command.times": [0.0], "command.velocities": [0.4]},
            {"lmpc.height": 0.25, "command.times": [0.0, 1.0], "command.velocities": [0.1, 0.2]},
            {"gait.names": ["trot", "bound"], "gait.times": [0.0, 2.0]},
        )
    ]
    params, axes = cases.stack_params(configs, np.float64)
    assert axes.height == 0
    assert axes.swing.kp is None  # alike for all, so held once
    for i, config in enumerate(configs):
        own = build_params(config, go1.PARAMS)
        for name in ("height", "swing", "tables"):
            jax.tree.map(
                lambda axis, leaf, want, i=i: np.testing.assert_array_equal(
                    leaf if axis is None else leaf[i], want
                ),
                getattr(axes, name),
                getattr(params, name),
                getattr(own, name),
                is_leaf=lambda a: a is None,
            )
        count = len(config.command.times)
        np.testing.assert_array_equal(params.command.times[i, :count], config.command.times)
        assert np.isinf(params.command.times[i, count:]).all()
        assert params.gaits[i, 0] == own.gaits[0]
        assert params.gait_times.shape == (3, 2)


def test_a_delay_that_no_step_holds_is_refused():
    with pytest.raises(ConfigError, match=r"sim\.delay"):
        load_config(RunConfig, None, {"sim.delay": 0.0015})
