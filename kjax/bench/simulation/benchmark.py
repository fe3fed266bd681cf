"""Closed loops per second of both engines beside the bare ones; for benchmark.py simulation."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco.batch
import numpy as np

from kjax.bench.machine import cores, peak_memory, two_process_speedup
from kjax.bench.options import BenchOptions
from kjax.bench.simulation import report
from kjax.bench.timing import Call, elapsed, interleaved, median_ratio, reported
from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.robots import get_robot
from kjax.sim.batching import scene_models
from kjax.sim.engines.mjx import MjxEngine
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.engines.mujoco_batch import BatchEngine
from kjax.sim.episode import Episode, initial_state
from kjax.sim.mjx_import import mjx, mjx_step
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_episodes

BATCHES = (16, 128, 1024)
MJX_BATCHES = (16, 128, 1024)
ENGINE_CASES = 64  # episodes of both engines
ROUNDS = 5  # of closed loop and bare engine in turn; medians of each, and of their ratios
EPISODE = 0.5  # s of closed loop that are timed in C
EPISODE_MJX = 0.25


def run(folder: Path, args: BenchOptions) -> dict[str, Any]:
    """All measurements; leaves figure.png and table.md in the folder."""
    quick = args.quick
    jax.config.update("jax_enable_x64", False)
    batches = BATCHES[:3] if quick else BATCHES
    rounds = 2 if quick else ROUNDS
    result: dict[str, Any] = {"threads": len(cores()), "c": {}, "mjx": {}}
    for gait, torques in (("trot", "held"), ("trot", "every_step"), ("bound", "held")):
        sizes = batches if (gait, torques) == ("trot", "held") else batches[-1:]
        for size in sizes:
            entry = c_batch(gait, torques, size, rounds)
            result["c"][f"{gait}, {torques}, {size}"] = entry
            print(f"C, {gait}, {torques}, {size}: {entry['robot_steps_per_s']:.0f} robot-steps/s, "
                  f"{entry['over_bare']:.3f} of the bare engine", flush=True)  # fmt: skip
    result["python_loop"] = python_loop(0.5 if quick else 4.0)
    for size in MJX_BATCHES[:1] if quick else MJX_BATCHES:
        entry = elsewhere(f"mjx_batch({size}, {rounds if size < 1024 else 2})")
        result["mjx"][str(size)] = entry
        print(f"MJX, trot, every_step, {size}: {entry['robot_steps_per_s']:.0f} robot-steps/s, "
              f"{entry['over_bare']:.3f} of the bare one, compiled in {entry['compile_s']:.0f} s",
              flush=True)  # fmt: skip
    if not quick:
        result |= elsewhere("engines_agree()")
        result |= mjx_compile_times()
        result["machine_two_process_speedup"] = two_process_speedup()
        result |= two_processes(folder)
    result |= headline(result)
    (folder / "table.md").write_text(report.table(result), encoding="utf-8")
    report.figure(result, folder / "figure.png")
    return result


def headline(result: dict[str, Any]) -> dict[str, float]:
    """The ratios that are quoted."""
    largest = max(int(key.split(", ")[-1]) for key in result["c"])
    held, every, bound = (
        result["c"][f"{name}, {largest}"]
        for name in ("trot, held", "trot, every_step", "bound, held")
    )
    return {
        "c_held_over_bare": held["over_bare"],
        "c_every_step_over_bare": every["over_bare"],
        "c_bound_held_over_bare": bound["over_bare"],
        "c_batch_over_loop": held["robot_steps_per_s"] / result["python_loop"]["robot_steps_per_s"],
        "mjx_closed_over_bare": result["mjx"].get("128", result["mjx"]["16"])["over_bare"],
    }


def cases(gait: str, count: int, seconds: float) -> list[RunConfig]:
    """Flat ground, constant speed, another seed for each robot."""
    speed = {"trot": 0.3, "bound": 0.5}[gait]
    name = {"trot": "trot_velocity", "bound": "bound_velocity"}[gait]
    overrides = {
        "sim.contacts": "feet",
        "duration": seconds,
        "command.times": [0.0],
        "command.v_x": [speed],
        "lmpc.command_slew": 1.0,  # none shall fall: the fallen cost nothing
    }
    config = load_config(RunConfig, shipped_config(f"{name}.toml"), overrides)
    return [dataclasses.replace(config, seed=seed) for seed in range(count)]


def c_batch(gait: str, torques: Any, size: int, rounds: int) -> dict[str, float]:
    """Closed loop, and the bare engine on the torques of that loop, in turn."""
    seconds = EPISODE if size >= 1024 else 2.0 * EPISODE
    episodes = resolve_episodes(cases(gait, size, seconds))
    spec = episodes[0].spec
    engine = BatchEngine(spec, torques=torques)
    recording = engine.run(episodes)  # compiles
    bare = bare_batch(engine, episodes, recording.torque, torques)
    steps, per_tick = size * round(seconds / spec.scene.sim_dt), spec.per_tick
    completed = int(recording.ticks.sum()) * per_tick  # fewer steps where a robot fell
    calls: dict[str, Call] = {
        "closed": lambda _: engine.run(episodes).wall_time,
        "bare": lambda _: bare(),
    }
    times = interleaved(calls, rounds, warm_up=0, measure=reported)
    ratios = times["bare"] / times["closed"] * completed / steps
    return {
        "robot_steps_per_s": completed / float(np.median(times["closed"])),
        "bare_robot_steps_per_s": steps / float(np.median(times["bare"])),
        "over_bare": float(np.median(ratios)),
        "over_bare_min": float(ratios.min()),
        "over_bare_max": float(ratios.max()),
        "falls": int(recording.fell.sum()),
        "resident_MB": peak_memory(),
    }


def bare_batch(
    engine: BatchEngine, episodes: Sequence[Episode], torque: np.ndarray, torques: str
) -> Callable[[], float]:
    """MuJoCo's own batch with as many threads, fed recorded torques: time of a run [s]."""
    robot = get_robot(engine.spec.scene.robot)
    model = scene_models(robot, engine.model, episodes[:1])[0]
    per_tick = engine.spec.per_tick
    batch = mujoco.batch.Batch(model, nsim=len(episodes), nthread=engine.threads)
    qpos, qvel, ctrl = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
    at = find_addresses(robot, model)
    order = np.argsort(at.actuator.reshape(-1))
    starts = [initial_state(one.start, model, at) for one in episodes]

    def once() -> float:
        batch.reset()
        for i, (q, v) in enumerate(starts):
            qpos[i], qvel[i] = q, v
        batch.forward()
        clock = time.perf_counter()
        for row in torque:
            ctrl[:] = row[:, order]
            if torques == "held":
                batch.step(nstep=per_tick)
            else:
                for _ in range(per_tick):
                    batch.step(nstep=1)
        return time.perf_counter() - clock

    return once


def python_loop(seconds: float) -> dict[str, float]:
    """The obvious alternative: one robot after the other, torques at every step."""
    config = cases("trot", 1, seconds)[0]
    simulation = MujocoEngine(batch_spec(config))
    simulate(simulation, resolve_episode(config))
    times = [
        simulate(simulation, resolve_episode(config, seed=seed)).wall_time for seed in range(3)
    ]
    return {
        "robot_steps_per_s": round(seconds / config.sim.sim_dt) / float(np.median(times)),
    }


def mjx_batch(size: int, rounds: int) -> dict[str, float]:
    """Closed loop on MJX, and ``mjx.step`` in a scan with torques held, in turn."""
    episodes = resolve_episodes(cases("trot", size, EPISODE_MJX))
    spec = episodes[0].spec
    engine = MjxEngine(spec)
    clock = time.perf_counter()
    recording = engine.run(episodes)
    first = time.perf_counter() - clock
    robot = get_robot(spec.scene.robot)
    model = mjx.put_model(scene_models(robot, engine.model, episodes[:1])[0])
    steps, per_tick = round(EPISODE_MJX / spec.scene.sim_dt), spec.per_tick
    at = find_addresses(robot, engine.model)
    order = np.argsort(at.actuator.reshape(-1))

    def begin(qpos: Any, qvel: Any) -> Any:
        data = mjx.make_data(model)
        data = data.replace(qpos=data.qpos.at[:].set(qpos), qvel=data.qvel.at[:].set(qvel))
        return mjx.forward(model, data)

    def rollout(data: Any, torque: Any) -> Any:
        def tick(data: Any, row: Any) -> Any:
            def step(data: Any, _: None) -> Any:
                stepped = mjx_step(model, data.replace(ctrl=row))
                return jax.tree.map(lambda a, b: a.astype(b.dtype), stepped, data), None

            return jax.lax.scan(step, data, None, length=per_tick)[0], data.qpos

        return jax.lax.scan(tick, data, torque)

    starts = [initial_state(one.start, engine.model, at) for one in episodes]
    qpos, qvel = (np.stack(a) for a in zip(*starts, strict=True))
    data = jax.jit(jax.vmap(begin))(qpos, qvel)
    bare = jax.jit(jax.vmap(rollout, (0, 1)))
    torque = recording.torque[: len(recording.qpos)][..., order]
    jax.block_until_ready(bare(data, torque))
    calls: dict[str, Call] = {
        "closed": lambda _: engine.run(episodes).wall_time,
        "bare": lambda _: elapsed(bare, data, torque),
    }
    times = interleaved(calls, rounds, warm_up=0, measure=reported)
    return {
        "robot_steps_per_s": size * steps / float(np.median(times["closed"])),
        "bare_robot_steps_per_s": size * steps / float(np.median(times["bare"])),
        "over_bare": median_ratio(times["bare"], times["closed"]),
        "compile_s": first - float(np.median(times["closed"])),
        "traces": engine.traces,
        "falls": int(recording.fell.sum()),
        "resident_MB": peak_memory(),
    }


def elsewhere(call: str) -> dict[str, Any]:
    """A function of this module in a process of its own, in which XLA uses all cores for MJX."""
    code = (
        "import json\n"
        "from kjax import cli; cli.configure_jax(parallel=True)\n"
        "import jax; jax.config.update('jax_enable_x64', False)\n"
        "import kjax.bench.simulation.benchmark as here\n"
        f"print('RESULT' + json.dumps(here.{call}))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE, text=True, check=True,
    )  # fmt: skip
    before, _, result = done.stdout.rpartition("RESULT")
    print(before, end="", flush=True)
    return json.loads(result)


def engines_agree() -> dict[str, Any]:
    """The same rough trots in C and on MJX in single precision: falls, and medians of the RMSE."""
    overrides = {
        "sim.contacts": "feet",
        "duration": 3.0,
        "lmpc.command_slew": 1.0,
        "command.times": [0.0],
        "command.v_x": [0.4],
        "terrain.start": 0.5,
        "terrain.end": 1.4,
    }
    config = load_config(RunConfig, shipped_config("trot_rough.toml"), overrides)
    configs = [
        dataclasses.replace(
            config, seed=seed, terrain=dataclasses.replace(config.terrain, seed=seed)
        )
        for seed in range(ENGINE_CASES)
    ]
    rmse, fell = {}, {}
    for name, engine in (
        ("c", BatchEngine(batch_spec(config), torques="every_step")),
        ("mjx", MjxEngine(batch_spec(config), torques="every_step")),
    ):
        recording = engine.run(resolve_episodes(configs))
        fell[name] = recording.fell
        rmse[name] = np.array([row["velocity_rmse_mps"] for row in recording.metrics()], float)
    both = ~fell["c"] & ~fell["mjx"]
    medians = {name: float(np.median(values[both])) for name, values in rmse.items()}
    same = int((fell["c"] == fell["mjx"]).sum())
    print(f"both engines: the same verdict on {same} of {ENGINE_CASES} fields, median RMSE "
          f"{medians['c']:.4f} and {medians['mjx']:.4f} m/s", flush=True)  # fmt: skip
    return {
        "engines_cases": ENGINE_CASES,
        "engines_same_verdict": same,
        "engines_falls": {name: int(values.sum()) for name, values in fell.items()},
        "engines_rmse_median_mps": medians,
        "engines_rmse_ratio": medians["mjx"] / medians["c"],
    }


def mjx_compile_times() -> dict[str, float]:
    """First call of a closed loop of 16 robots with an empty compile cache, and with a full one."""
    code = (
        "import time\n"
        "from kjax import cli; cli.configure_jax(parallel=True)\n"
        "import jax; jax.config.update('jax_enable_x64', False)\n"
        "import kjax.bench.simulation.benchmark as b\n"
        "from kjax.sim.engines.mjx import MjxEngine\n"
        "from kjax.sim.resolve import resolve_episodes\n"
        "walks = resolve_episodes(b.cases('trot', 16, 0.05)); engine = MjxEngine(walks[0].spec)\n"
        "clock = time.perf_counter(); r = engine.run(walks)\n"
        "print(time.perf_counter() - clock)\n"
    )
    times = []
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(2):
            done = subprocess.run(
                [sys.executable, "-c", code],
                env={**os.environ, "JAX_COMPILATION_CACHE_DIR": cache},
                capture_output=True, text=True, check=True,
            )  # fmt: skip
            times.append(float(done.stdout.splitlines()[-1]))
    return {"mjx_compile_s_cold": times[0], "mjx_compile_s_cached": times[1]}


def two_processes(folder: Path) -> dict[str, float]:
    """A sweep on two processes of one thread each beside one, both compiled before.

    The speedup is that of the episodes: the sum of both rates over the rate of one, without each
    process's first chunk, which loads the program. ``..._whole`` is that of the whole command, the
    start of which, some 15 s, does not get shorter.
    """
    sweep = shipped_config("sweeps/benchmark.toml")

    def once(count: int, *options: str) -> tuple[float, float]:
        out = folder / f"processes_{count}"
        common = [
            sys.executable,
            "-m",
            "kjax.studies.sweep",
            str(sweep),
            "--threads",
            "1",
            "--restart",
            *options,
        ]
        clock = time.perf_counter()
        running = []
        for number in range(count):
            more = [] if count == 1 else [
                "--coordinator", "127.0.0.1:12355", "--processes", str(count),
                "--process", str(number),
            ]  # fmt: skip
            pin = ["taskset", "-c", str(cores()[number % len(cores())])]
            running.append(
                subprocess.Popen(
                    [*pin, *common, *more, "--out", str(out)],
                    stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                )
            )  # fmt: skip
        texts = [process.communicate()[0] for process in running]
        if any(process.returncode for process in running):
            raise RuntimeError("\n".join(texts))
        rates = [re.findall(r"([0-9.]+) k robot-steps/s", text)[1:] for text in texts]
        rate = sum(float(np.median([float(r) for r in own])) for own in rates if own)
        return time.perf_counter() - clock, rate

    once(1, "--seeds", "64")
    (alone, one), (together, two) = once(1), once(2)
    return {"two_process_speedup": two / one, "two_process_speedup_whole": alone / together}
