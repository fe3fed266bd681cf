"""What is asked of the robot: columns that are followed, and those that are refused or told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import Command, ConfigError, ControlLoop, RunConfig, build_controller, load_config
from kjax.controllers.params import condense, with_params
from kjax.controllers.resolve import build_command, resolve
from kjax.legs.posture import stand_pose, standing
from kjax.robots import go1
from kjax.types import COMMAND_NAMES

CONFIG = RunConfig()


@pytest.fixture(scope="module")
def resolved():
    return resolve(CONFIG, go1.PARAMS)


def test_a_config_gives_a_row_of_all_columns_for_each_time():
    keys = {"command.times": [0.0, 2.0], "command.v_x": [0.1, 0.3], "command.height": [0.0, -0.02]}
    command = build_command(load_config(RunConfig, None, keys).command)
    np.testing.assert_array_equal(command.times, [0.0, 2.0])
    np.testing.assert_array_equal(
        command.values, [[0.1, 0.0, 0.0, 0.0, 0.0, 0.0], [0.3, 0.0, 0.0, -0.02, 0.0, 0.0]]
    )


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"command.velocities": [0.1]}, ("command.velocities", "command.v_x")),
        ({"command.height": [0.1]}, ("command", "height", "got 1 and 5")),
        ({"command.v_x": [0.1]}, ("command", "v_x", "5 and 1")),
    ],
)
def test_a_command_that_cannot_be_read_names_the_key(keys, words):
    with pytest.raises(ConfigError) as caught:
        load_config(RunConfig, None, keys)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize("name", ["v_y", "yaw_rate", "roll", "pitch"])
def test_what_the_planar_controller_does_not_follow_is_refused_at_the_edge(name):
    config = load_config(RunConfig, None, {f"command.{name}": [0.0, 0.0, 0.1, 0.0, 0.0]})
    with pytest.raises(ValueError, match=rf"command\.{name}: .*follows v_x and height only"):
        resolve(config, go1.PARAMS)


@pytest.mark.parametrize("height", [-0.2, 0.2])
def test_a_height_that_the_legs_do_not_reach_is_refused(height):
    config = load_config(RunConfig, None, {"command.height": [0.0, height, 0.0, 0.0, 0.0]})
    with pytest.raises(
        ValueError,
        match=r"body_height is 0\.6338 leg lengths, 0\.27 m, and command\.height .* m, but",
    ):
        resolve(config, go1.PARAMS)


def test_traced_code_tells_of_what_it_does_not_follow(resolved):
    spec, params = resolved
    controller, tables = build_controller(spec), condense(spec, params)
    plan = jax.jit(controller.plan)
    observation = jax.tree.map(jnp.asarray, standing(jnp.asarray(stand_pose(go1.PARAMS, 0.27)[1])))
    state = controller.init(tables, observation)
    for column, name in enumerate(COMMAND_NAMES):
        asked = with_params(tables, command=tables.params.command.hold(**{name: 0.1}))
        state_after, info = plan(asked, state, observation)
        assert bool(info.command_ignored) == (name not in ("v_x", "height"))
        np.testing.assert_allclose(state_after.command, 0.1 * (np.arange(6) == column), rtol=1e-6)
    assert plan._cache_size() == 1


def test_the_height_follows_the_command_at_its_rate(resolved):
    spec, params = resolved
    controller, tables = build_controller(spec), condense(spec, params)
    plan = jax.jit(controller.plan)
    observation = jax.tree.map(jnp.asarray, standing(jnp.asarray(stand_pose(go1.PARAMS, 0.27)[1])))
    tables = with_params(tables, command=tables.params.command.hold(height=-0.004))
    state, heights = controller.init(tables, observation), []
    for _ in range(6):
        state, info = plan(tables, state, observation)
        heights.append(float(info.reference[1]))
    # 0.2 m/s for 5 ms at a time, then it is there.
    wanted = 0.426 * 0.6338 - 0.001 * np.minimum(np.arange(1, 7), 4)
    np.testing.assert_allclose(heights, wanted, atol=1e-12)


def test_a_command_of_the_same_shape_holds_at_all_times():
    command = Command(times=np.array([0.0, 1.0]), values=np.ones((2, 6)))
    held = command.hold(v_x=0.3, height=-0.02)
    np.testing.assert_array_equal(held.times, command.times)
    np.testing.assert_array_equal(held.values, [[0.3, 0.0, 0.0, -0.02, 0.0, 0.0]] * 2)
    with pytest.raises(ValueError, match="v_z: no column of a command, wanted"):
        command.hold(v_z=0.1)


def test_a_loop_takes_another_command_without_compiling(resolved):
    loop = ControlLoop(*resolved)
    sample = standing(stand_pose(go1.PARAMS, 0.27)[1])
    loop.step(sample, 0.0)
    compiled = []

    def listen(event, seconds, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        loop.command(v_x=0.2, height=0.01)
        loop.step(sample, 0.005)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert compiled == []
    np.testing.assert_allclose(loop.state.command, [0.2, 0.0, 0.0, 0.01, 0.0, 0.0], rtol=1e-6)
    assert 0.0 < float(loop.state.velocity[0]) < 0.2
    for wrong, words in (
        ({"yaw_rate": 0.1}, "command.yaw_rate: .* follows v_x and height only"),
        ({"v_x": np.nan}, "command.v_x: .* wanted finite"),
        ({"speed": 0.1}, "speed: no column"),
    ):
        with pytest.raises(ValueError, match=words):
            loop.command(**wrong)
    loop.step(sample, 0.010)
    np.testing.assert_allclose(loop.state.command[0], 0.2, rtol=1e-6)  # still the last good one
