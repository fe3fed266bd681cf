"""A caller's own loop: when it plans, what it refuses, what it tells."""

import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.controllers import control_loop
from kjax.controllers.control_loop import PERIOD_CALLS, ControlLoop
from kjax.controllers.controller import Controller
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.types import JointCommand, Observation, RobotParams


class Stub:
    """A controller that counts; the loop's own logic needs no walking robot."""

    def __init__(self, control_dt=0.005, act_dt=0.001):
        self.traced, self.control_dt, self.act_dt = 0, control_dt, act_dt

    def record(self):
        def init(params, observation):
            self.traced += 1
            return {"plans": jnp.zeros(()), "acts": jnp.zeros(())}

        def plan(params, state, observation):
            self.traced += 1
            return state | {"plans": state["plans"] + 1}, state["plans"] + 1

        def act(params, state, observation):
            self.traced += 1
            return state | {"acts": state["acts"] + 1}, JointCommand(
                *[jnp.full((4, 3), state["plans"])] * 6
            )

        return Controller(
            init=init, plan=plan, act=act, step=None, init_from=None, plan_from=None,
            control_dt=self.control_dt, act_dt=self.act_dt,
        )  # fmt: skip


def sample(**changes):
    height, joints = stand_pose(go1.PARAMS, 0.27)
    values = {
        "base_pos": [0.0, 0.0, height],
        "base_quat": [1.0, 0.0, 0.0, 0.0],
        "base_vel": np.zeros(3),
        "base_ang_vel": np.zeros(3),
        "joint_pos": joints,
        "joint_vel": np.zeros((4, 3)),
        "contact": np.ones(4, bool),
    }
    return Observation(**(values | changes))


class Params(NamedTuple):
    """What the loop itself reads of a controller's parameters."""

    robot: RobotParams = go1.PARAMS


@pytest.fixture
def loop_of(monkeypatch):
    """A loop around a stub in place of the controller."""

    def build(stub):
        monkeypatch.setattr(control_loop, "build_controller", lambda spec: stub.record())
        monkeypatch.setattr(control_loop, "condense", lambda spec, params: params)
        return ControlLoop(None, Params())

    return build


@pytest.mark.parametrize("kind", [np.float64, np.float32, list])
def test_the_first_torque_is_of_the_first_sample(loop_of, kind):
    """All is compiled when the loop is made: a robot does not wait for that on its feet."""
    stub = Stub()
    loop = loop_of(stub)
    assert (stub.traced, loop.state, loop.info) == (3, None, None)
    for i in range(10):
        values = {k: np.asarray(v).tolist() if kind is list else np.asarray(v).astype(kind)
                  for k, v in sample()._asdict().items()}  # fmt: skip
        loop.step(Observation(**values), 0.001 * i)
    assert stub.traced == 3


def test_nothing_is_compiled_at_the_first_sample(loop_of):
    compiled = []

    def listen(event, seconds, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(seconds)

    first = sample()
    jax.clear_caches()
    loop = loop_of(Stub())
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        loop.step(first, 0.0)
        assert compiled == []
        jax.jit(lambda x: x + 1.0)(1.0)
        assert len(compiled) == 1  # it does listen
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_it_plans_at_the_control_rate_whatever_clock_it_is_given(loop_of):
    for start in (0.0, 1.7e9 * 1e-3):  # a computer's uptime
        loop = loop_of(Stub())
        plans = [loop.step(sample(), start + 0.001 * i).torque[0, 0] for i in range(20)]
        assert plans == [1] * 5 + [2] * 5 + [3] * 5 + [4] * 5


def test_after_a_pause_it_plans_at_once_and_goes_on_at_its_rate(loop_of):
    loop = loop_of(Stub())
    for i in range(4):
        loop.step(sample(), 0.001 * i)
    plans = [loop.step(sample(), 1.0 + 0.001 * i).torque[0, 0] for i in range(10)]
    assert plans == [2] * 5 + [3] * 5


@pytest.mark.parametrize("time", [0.003, 0.002, np.nan])
def test_a_time_that_does_not_run_on_is_refused(loop_of, time):
    loop = loop_of(Stub())
    loop.step(sample(), 0.003)
    with pytest.raises(ValueError, match=r"time must run on from 0\.003 s, got .* reset\(\)"):
        loop.step(sample(), time)
    loop.reset()
    assert loop.step(sample(), 0.0).torque[0, 0] == 1


def test_another_rate_than_the_controllers_is_told_once(loop_of):
    loop = loop_of(Stub())
    for i in range(PERIOD_CALLS):
        loop.step(sample(), 0.005 * i)
    with pytest.warns(UserWarning, match=r"every 5 ms, .* built for 1 ms.*leg\.act_dt = 0\.005"):
        loop.step(sample(), 0.005 * PERIOD_CALLS)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for i in range(PERIOD_CALLS + 1, 3 * PERIOD_CALLS):
            loop.step(sample(), 0.005 * i)
    assert told == []


def test_a_flag_that_is_no_number_does_not_stop_a_walk(loop_of):
    loop = loop_of(Stub())
    loop.step(sample(), 0.0)
    assert loop.step(sample(contact=np.array([1.0, np.nan, 1.0, 1.0])), 0.001).torque.shape == (
        4,
        3,
    )


def test_pauses_are_no_rate(loop_of):
    loop = loop_of(Stub())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for time in [0.0, *(6.0 + 0.001 * np.arange(40)), *(9.0 + 0.001 * np.arange(40))]:
            loop.step(sample(), time)
    assert told == []


def test_a_jittering_clock_is_not_complained_of(loop_of):
    loop, rng = loop_of(Stub()), np.random.default_rng(0)
    times = np.cumsum(0.001 * rng.uniform(0.5, 1.5, 200))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for time in times:
            loop.step(sample(), time)
    assert told == []


def test_a_wrong_shape_is_refused_at_every_call(loop_of):
    loop = loop_of(Stub())
    loop.step(sample(), 0.0)
    with pytest.raises(ValueError, match=r"observation\.joint_pos: got shape \(12,\), wanted"):
        loop.step(sample(joint_pos=np.zeros(12)), 0.001)
