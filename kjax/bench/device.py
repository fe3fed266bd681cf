"""What a GPU gains: the batched parts on every kind of device of this machine, in float32.

Each kind of device has a process of its own, since JAX chooses one for all that it compiles. Inputs
lie on the device, and results are waited for.
"""

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from kjax import qp
from kjax.bench.edmd import data as edmd_data
from kjax.bench.options import BenchOptions
from kjax.bench.simulation import benchmark as simulation
from kjax.bench.timing import elapsed
from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.controller import build_controller
from kjax.controllers.params import condense
from kjax.koopman import edmd
from kjax.sim.engines.mjx import MjxEngine
from kjax.sim.engines.mujoco import MujocoEngine
from kjax.sim.episode import initial_state
from kjax.sim.resolve import resolve_episode, resolve_episodes
from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table

SIZES = {"cpu": (1024, 16384), "gpu": (1024, 16384, 131072)}  # robots, QPs
MJX_SIZES = {"cpu": (1024,), "gpu": (1024, 4096, 8192)}
SPATIAL_SIZES = {"cpu": (1024,), "gpu": (1024, 16384)}
ROUNDS = 5
VARIABLES = 24  # of the random QPs, as many as the trot's have
SNAPSHOTS = 10_000_000
PARTS: Final = ("controller", "qp", "edmd", "mjx", "spatial", "mjx_spatial")


@dataclass(kw_only=True)
class DeviceOptions(BenchOptions):
    """Options of this benchmark."""

    parts: tuple[Literal["controller", "qp", "edmd", "mjx", "spatial", "mjx_spatial"], ...] = PARTS
    """What is measured: of the planar controller and of the spatial one, each alone and on MJX."""

    kinds: tuple[Literal["cpu", "gpu"], ...] = ()
    """Kinds of device; all that this machine has if left out."""


OPTIONS = DeviceOptions


def run(folder: Path, args: DeviceOptions) -> dict[str, Any]:
    """All measurements on each kind of device; leaves figure.png and table.md in the folder."""
    kinds = ["cpu"] if jax.default_backend() == "cpu" else ["gpu", "cpu"]
    kinds = [kind for kind in kinds if not args.kinds or kind in args.kinds]
    result: dict[str, Any] = {"devices": {}}
    for kind in kinds:
        for part in args.parts:
            entry = _elsewhere(kind, part, args.quick)
            print(f"{kind}, {part}: {json.dumps(entry)}", flush=True)
            result["devices"].setdefault(kind, {}).update(entry)
    (folder / "table.md").write_text(table(result), encoding="utf-8")
    figure(result, folder / "figure.png")
    return result


def _elsewhere(kind: str, part: str, quick: bool) -> dict[str, Any]:
    """One part in a process of its own on one kind of device."""
    code = (
        "import json\n"
        "from kjax import cli; cli.configure_jax(parallel=True)\n"
        "import jax; jax.config.update('jax_enable_x64', False)\n"
        "from kjax.bench import device\n"
        f"print('RESULT' + json.dumps(device.measure({kind!r}, {part!r}, {quick})))\n"
    )
    environment = dict(os.environ, JAX_PLATFORMS="cpu") if kind == "cpu" else dict(os.environ)
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment
    )
    before, found, result = done.stdout.rpartition("RESULT")
    print(before, end="", flush=True)
    if done.returncode or not found:
        return {part: {"failed": f"exit code {done.returncode}"}}
    return json.loads(result)


def measure(kind: str, part: str, quick: bool) -> dict[str, Any]:
    """One part on the device of this process."""
    sizes = SIZES[kind][:1] if quick else SIZES[kind]
    named = {"name": jax.devices()[0].device_kind, "cores": os.cpu_count()}
    if part in ("mjx", "mjx_spatial"):
        walks = MJX_SIZES[kind][:1] if quick else MJX_SIZES[kind]
        walks = walks[::2] if part == "mjx_spatial" else walks  # a minute of compilation each
        return named | {part: {str(n): mjx_walks(part, n) for n in walks}}
    if part == "spatial":
        sizes = SPATIAL_SIZES[kind][:1] if quick else SPATIAL_SIZES[kind]
    if part == "edmd":
        return named | {"edmd": data_and_fit(SNAPSHOTS // (100 if quick else 1))}
    if part == "qp":
        return named | {part: {str(n): box_qps(n) for n in sizes}}
    return named | {part: {str(n): controller(part, n) for n in sizes}}


def _walks(part: str, robots: int) -> list[RunConfig]:
    """Configs of the planar controller's trot, or of the spatial one's, turning and sideways."""
    duration = simulation.EPISODE_MJX
    if "spatial" not in part:
        return simulation.cases("trot", robots, duration)
    config = load_config(
        RunConfig,
        shipped_config("omni_trot"),
        {
            "gait.also": [], "duration": duration, "sim.contacts": "feet", "command.times": [0.0],
            "command.v_x": [0.5], "command.v_y": [0.2], "command.yaw_rate": [0.5],
        },
    )  # fmt: skip
    return [dataclasses.replace(config, seed=seed) for seed in range(robots)]


def _rate(call: Callable[[], Any], per_call: int) -> dict[str, float]:
    """Calls once to compile, and then ``ROUNDS`` times: items per second by the median."""
    first = elapsed(call)
    seconds = float(np.median([elapsed(call) for _ in range(ROUNDS)]))
    return {"per_s": per_call / seconds, "seconds": seconds, "compile_s": first - seconds}


def controller(part: str, robots: int) -> dict[str, float]:
    """Control ticks per second: one plan and the joint torques of its five samples, per robot."""
    episode = resolve_episode(_walks(part, 1)[0])
    engine = MujocoEngine(episode.spec)
    qpos, qvel = initial_state(episode.start, engine.model, engine.addresses)
    sensors = jnp.zeros(engine.model.nsensordata)
    standing = engine.observe(jnp.asarray(qpos), jnp.asarray(qvel), sensors)
    control = build_controller(episode.spec.controller)
    tables = condense(episode.spec.controller, episode.controller, dtype=np.float32)

    def tick(state: Any, observation: Any) -> Any:
        state, _ = control.plan(tables, state, observation)

        def act(state: Any, _: None) -> Any:
            state, joints = control.act(tables, state, observation)
            return state, joints.torque

        return jax.lax.scan(act, state, None, length=episode.spec.per_tick)

    key = jax.random.key(0)

    def noisy(leaf: Any) -> Any:
        leaf = jnp.broadcast_to(jnp.asarray(leaf), (robots, *np.shape(leaf)))
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            return leaf
        return leaf.astype(jnp.float32) + 0.003 * jax.random.normal(key, leaf.shape)

    observations = jax.tree.map(noisy, standing)
    states = jax.jit(jax.vmap(lambda seen: control.init(tables, seen)))(observations)
    many = jax.jit(jax.vmap(tick))
    return _rate(lambda: many(states, observations), robots)


def box_qps(count: int) -> dict[str, float]:
    """Box QPs per second, each with a Hessian of its own, and the share that is solved."""
    keys = jax.random.split(jax.random.key(1), 2)
    root = jax.random.normal(keys[0], (count, VARIABLES, VARIABLES)) / VARIABLES**0.5
    H = jnp.einsum("bij,bkj->bik", root, root) + 0.1 * jnp.eye(VARIABLES)
    q = jax.random.normal(keys[1], (count, VARIABLES))
    lower, upper = jnp.full((count, VARIABLES), -0.5), jnp.full((count, VARIABLES), 0.5)

    def solve(H: Any, q: Any, lower: Any, upper: Any) -> Any:
        solution = qp.solve(qp.prepare(H), q, lower, upper)
        return solution.x, solution.status

    many = jax.jit(jax.vmap(solve))
    rate = _rate(lambda: many(H, q, lower, upper), count)
    status = np.asarray(many(H, q, lower, upper)[1])
    return rate | {"solved": float(np.mean(status == int(qp.Status.SOLVED)))}


def data_and_fit(snapshots: int) -> dict[str, Any]:
    """Snapshots drawn per second (RK4 rollouts), and fitted per second by EDMD."""
    here = edmd_data.setting()
    rollouts = snapshots // here.steps
    draw = edmd_data.sampler(here, rollouts, here.steps)
    fit = jax.jit(lambda drawn: edmd.fit(edmd_data.PAPER, drawn))
    count = rollouts * here.steps
    drawing = _rate(lambda: draw(jax.random.key(0)), count)
    drawn = draw(jax.random.key(0))
    return {"snapshots": count, "draw": drawing, "fit": _rate(lambda: fit(drawn), count)}


def mjx_walks(part: str, robots: int) -> dict[str, float]:
    """Closed loops on MJX: robot-steps per second, and what the host does before and after."""
    episodes = resolve_episodes(_walks(part, robots))
    engine = MjxEngine(episodes[0].spec)
    recordings, whole = [], []
    for _ in range(3):
        begin = time.perf_counter()
        recordings.append(engine.run(episodes))
        whole.append(time.perf_counter() - begin)
    seconds = float(np.median([one.wall_time for one in recordings[1:]]))
    steps = round(simulation.EPISODE_MJX / episodes[0].spec.scene.sim_dt)
    return {
        "per_s": robots * steps / seconds,
        "seconds": seconds,
        "compile_s": recordings[0].wall_time - seconds,
        "host_s": float(np.median(whole[1:])) - seconds,
        "falls": int(recordings[-1].fell.sum()),
    }


UNITS = {
    "controller": "ticks", "qp": "QPs", "mjx": "robot-steps", "spatial": "ticks",
    "mjx_spatial": "robot-steps",
}  # fmt: skip
NAMES = {
    "controller": "planar controller", "qp": "box QPs", "mjx": "planar trots on MJX",
    "spatial": "spatial controller", "mjx_spatial": "spatial trots on MJX",
}  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """All of it as Markdown."""
    rows = []
    for kind, entry in result["devices"].items():
        name = f"{entry['cores']} cores" if kind == "cpu" else entry["name"]
        lines = [
            (f"{NAMES[part]}, batch of {int(size):,}", found, UNITS[part])
            for part in UNITS
            for size, found in _found(entry, part).items()
        ]
        for part in ("draw", "fit"):
            count = entry.get("edmd", {}).get("snapshots", 0)
            if part in entry.get("edmd", {}):
                lines.append((f"EDMD, {part} {count:,}", entry["edmd"][part], "snapshots"))
        rows += [
            (name, what, f"{found['per_s']:,.0f} {unit}/s", f"{found['compile_s']:.1f}")
            for what, found, unit in lines
        ]
    return markdown_table(("device", "what", "rate", "compilation, s"), rows)


def _found(entry: dict[str, Any], part: str) -> dict[str, Any]:
    """What was measured of a part, by size; nothing if it failed."""
    return {} if "failed" in entry.get(part, {}) else entry.get(part, {})


@figure_style
def figure(result: dict[str, Any], path: Path) -> None:
    """Rates against the size of the batch, a line per device."""
    fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
    titles = {
        "control ticks/s (plan + 5 act)": ("controller", "spatial"),
        f"box QPs/s, {VARIABLES} variables": ("qp",),
        "robot-steps/s on MJX": ("mjx", "mjx_spatial"),
    }
    for ax, (title, parts) in zip(axes, titles.items(), strict=True):
        for kind, entry in result["devices"].items():
            name = f"{entry['cores']} cores" if kind == "cpu" else entry["name"]
            for part, line in zip(parts, ("o-", "s--"), strict=False):
                points = _found(entry, part)
                rates = [found["per_s"] for found in points.values()]
                own = f"{name}, spatial" if "spatial" in part else name
                ax.loglog([int(size) for size in points], rates, line, label=own)
        ax.set(xlabel="batch", title=title)
    axes[0].legend()
    fig.savefig(path)
    plt.close(fig)
