"""The QPs of closed loops, recorded by standing in for the solver while the planner is traced."""

from typing import Any
from unittest import mock

import jax
import mujoco
import numpy as np
from tqdm import tqdm

from kjax import qp
from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers import planning
from kjax.controllers.controller import build_controller
from kjax.controllers.params import condense
from kjax.controllers.resolve import controller_spec, resolve
from kjax.sim.engines.mujoco import MujocoEngine
from kjax.sim.episode import initial_state
from kjax.sim.resolve import resolve_episode


def _drive(config: RunConfig, planner: planning.Planner, seconds: float) -> list[Any]:
    """What ``planner`` returns as memory along a closed loop of the config's own controller."""
    episode = resolve_episode(config)
    simulation = MujocoEngine(episode.spec)
    controller, model = build_controller(controller_spec(config)), simulation.model
    tables = simulation.program(episode).tables
    recorder = build_controller(controller_spec(config), planner)
    plan, act = jax.jit(controller.plan), jax.jit(controller.act)
    look = jax.jit(lambda state, seen: recorder.plan(tables, state, seen)[0].memory)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = initial_state(episode.start, model, simulation.addresses)
    mujoco.mj_forward(model, data)
    state, kept = None, []
    steps = round(seconds / config.sim.sim_dt)
    per_tick = round(config.lmpc.control_dt / config.sim.sim_dt)
    for i in tqdm(range(steps), desc="closed loop", leave=False, disable=None):
        seen = simulation.observe(data.qpos, data.qvel, data.sensordata)
        if state is None:
            state = controller.init(tables, seen)
        if i % per_tick == 0:
            kept.append(jax.tree.map(np.array, look(state, seen)))
            state, _ = plan(tables, state, seen)
        state, joints = act(tables, state, seen)
        data.ctrl[simulation.addresses.actuator.reshape(-1)] = np.asarray(joints.torque).reshape(-1)
        mujoco.mj_step(model, data)
    return kept


def record_box(name: str, seconds: float, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The box QPs of a closed loop: prepared Hessians, modes, q and bounds of every tick.

    Of QPs with rows, which are seldom active, it is the box that is solved first.
    """
    config = load_config(RunConfig, shipped_config(f"{name}.toml"), changes or {})
    plan_of = planning.build_planner(controller_spec(config))

    def planner(tables: Any, task: Any) -> Any:
        seen: dict[str, Any] = {}

        def solve(prepared: Any, q: Any, lower: Any, upper: Any, *args: Any, **options: Any) -> Any:
            seen.update(q=q, lower=lower, upper=upper)
            return box(prepared, q, lower, upper, *args, **options)

        def solve_with_rows(prepared: Any, q: Any, *args: Any, **options: Any) -> Any:
            seen.update(q=q, lower=args[3], upper=args[4])  # behind the rows and their bounds
            return rows(prepared, q, *args, **options)

        box, rows = qp.solve, qp.solve_rows_from_box
        with (
            mock.patch.object(qp, "solve", solve),
            mock.patch.object(qp, "solve_rows_from_box", solve_with_rows),
        ):
            plan = plan_of(tables, task)
        recorded: Any = (plan.memory.problem, seen["q"], seen["lower"], seen["upper"])
        return plan._replace(memory=recorded)

    mode, q, lower, upper = map(np.stack, zip(*_drive(config, planner, seconds), strict=True))
    tables = condense(*resolve(config))
    assert tables.lmpc is not None
    hessian = tables.lmpc.hessian
    H = np.array(hessian.H / (hessian.scale[:, :, None] * hessian.scale[:, None, :]))
    used = (upper > lower).any(axis=1)  # nothing is planned in flight
    return {
        "prepared": jax.device_put(hessian),
        "mode": mode[used],
        "H": H,
        "q": q[used],
        "lower": lower[used],
        "upper": upper[used],
    }


def record_rows(seconds: float) -> list[tuple[np.ndarray, ...]]:
    """The QPs of a bound with a horizon through flight: arguments of ``qp.solve_rows``."""
    config = load_config(RunConfig, shipped_config("bound_multiphase.toml"), {})
    plan_of = planning.build_planner(controller_spec(config))

    def planner(tables: Any, task: Any) -> Any:
        seen: list[Any] = []

        def solve(*args: Any, **options: Any) -> Any:
            seen.append(args)
            return real(*args, **options)

        real = qp.solve_rows
        # The planner holds both horizons behind a cond, whose tracers may not leave it.
        with (
            mock.patch.object(qp, "solve_rows", solve),
            mock.patch.object(jax.lax, "cond", lambda _, yes, no, *args: yes(*args)),
        ):
            plan = plan_of(tables, task)
        return plan._replace(memory=seen[0])

    kept = _drive(config, planner, seconds)
    return [problem for problem in kept if (problem[6] > problem[5]).any()]
