"""Latency of the controller in the single-robot loop, beside its floors; start of the main job."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np

from kjax.bench.options import ControllerOptions
from kjax.bench.timing import Call, interleaved
from kjax.config import RunConfig
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.episode import Episode, initial_state
from kjax.sim.metrics import metrics
from kjax.sim.noise import noise_dim
from kjax.sim.program import requests
from kjax.sim.resolve import resolve_episode

CALLS = 2000  # timed calls of each function
EPISODE = 400  # physics steps of the closed loop that the timed inputs are taken from


def run(config: RunConfig, args: ControllerOptions) -> dict[str, Any]:
    """Latencies of a config's controller and, unless left out, the start-up times; prints them."""
    result = controller_latency(config)
    if not args.no_startup:
        result |= start_up(args.config)
    for key, value in result.items():
        print(f"{key:32}{value:12.4g}")
    return result


def controller_latency(config: RunConfig) -> dict[str, Any]:
    """Latency of the compiled calls on inputs from a closed loop, and of their floors [ms]."""
    episode = resolve_episode(config)
    simulation = MujocoEngine(episode.spec)
    states, sensed, data = _episode(simulation, episode)
    program = simulation.program(episode)
    noop = jax.jit(lambda state, sensed: (state + 1.0, sensed[:12] * 2.0))

    def on_inputs(call: Callable[[Any, Any], Any]) -> Call:
        return lambda i: np.asarray(call(states[i % len(states)], sensed[i % len(sensed)])[1])

    calls: dict[str, Call] = {
        "noop": on_inputs(noop),
        "act": on_inputs(program.act),
        "plan": on_inputs(program.plan),
        "physics": lambda _: mujoco.mj_step(simulation.model, data),
    }
    result: dict[str, Any] = {}
    for name, values in interleaved(calls, CALLS).items():
        result[f"{name}_ms_median"] = 1e3 * float(np.median(values))
        result[f"{name}_ms_p99"] = 1e3 * float(np.percentile(values, 99))
    result["act_over_noop"] = result["act_ms_median"] / result["noop_ms_median"]
    result["plan_over_noop"] = result["plan_ms_median"] / result["noop_ms_median"]
    runs = [
        metrics(simulate(simulation, resolve_episode(config, seed=seed)), episode.goal)
        for seed in range(3)
    ]
    result["realtime_factor"] = float(np.median([run["realtime_factor"] for run in runs]))
    return result


def _episode(
    simulation: MujocoEngine, episode: Episode
) -> tuple[list[Any], list[np.ndarray], mujoco.MjData]:
    """Controller states and sensor vectors along an episode, and the data at its end."""
    model, scene = simulation.model, simulation.spec.scene
    program = simulation.program(episode)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = initial_state(episode.start, model, simulation.addresses)
    mujoco.mj_forward(model, data)
    states, sensed = [], []
    noise = noise_dim(scene.base) * scene.noise
    state = None
    for i in range(EPISODE):
        now = np.concatenate([data.qpos, data.qvel, data.sensordata, np.zeros(noise)])
        state = program.init(now, requests(episode)) if state is None else state
        if i % 5 == 0:
            state, _ = program.plan(state, now)
        states.append(state)
        sensed.append(now)
        state, torque = program.act(state, now)
        data.ctrl[:] = torque
        mujoco.mj_step(model, data)
    return states, sensed, data


# The README's lines in one's own loop, from the import to the first torque.
_OWN_LOOP = """
from kjax import ControlLoop, RunConfig, resolve
from kjax.legs.posture import standing
loop = ControlLoop(*resolve(RunConfig()))
loop.step(standing(), time=0.0)
"""


def start_up(config: str | None) -> dict[str, float]:
    """Wall times of what a newcomer does, from an empty and then a filled compile cache [s]."""
    walk = ["-m", "kjax.studies.closed_loop", *([config] if config else [])]
    commands = {
        "first_run": walk,
        "second_run": walk,
        "own_loop_first": ["-c", _OWN_LOOP],
        "own_loop_second": ["-c", _OWN_LOOP],
        "seeds_run": [*walk, "--seeds", "4"],
        "switch_video_run": ["-m", "kjax", "run", "bound_to_trot", "--video"],
        "doctor": ["-m", "kjax", "doctor"],
    }
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        environment = {
            **os.environ,
            "JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        for name, words in commands.items():
            out = Path(folder) / ("run" if words is walk else name)
            begin = time.perf_counter()
            subprocess.run(
                [sys.executable, *words, *(["--out", str(out)] if name.endswith("run") else [])],
                env=environment,
                check=True,
                capture_output=True,
            )
            seconds[f"{name}_s"] = time.perf_counter() - begin
        inner = json.loads((Path(folder) / "run" / "metrics.json").read_text(encoding="utf-8"))
    return {**seconds, "second_run_realtime_factor": inner["realtime_factor"]}
