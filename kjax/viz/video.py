"""Videos of runs: MuJoCo's renderer where a GL library loads, a stick animation where none does.

Rendering happens in a child process per GL backend, since the backend is fixed when mujoco is
imported and a broken driver can take the process with it.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw
from tqdm import tqdm

from kjax.config import RunConfig, load_config
from kjax.robots import get_robot
from kjax.sim.trajectory import Trajectory
from kjax.types import Leg

FPS = 20
# Left legs are behind the right ones in a view from the right.
_FAR_TO_NEAR = {Leg.FL: "#90cdf4", Leg.RL: "#9ae6b4", Leg.FR: "#c53030", Leg.RR: "#dd6b20"}
SIZE = (640, 368)  # pixels; multiples of 16, as video codecs want
SHADOW_MAP = 1024  # pixels; MuJoCo's 4096 and its multisampling double a software renderer's time


def save_video(trajectory_file: Path, config_file: Path, path: Path) -> str:
    """Write an mp4 of a saved run; returns a line that says how it was drawn.

    Args:
      trajectory_file: ``trajectory.npz`` of the run.
      config_file: ``config.toml`` of the run.
      path: video to write.
    """
    wanted = os.environ.get("MUJOCO_GL")
    failures = []
    for backend in [wanted] if wanted else ["egl", "osmesa"]:
        code, last = _in_child(backend, str(trajectory_file), str(config_file), str(path))
        if code == 0:
            return f"rendered with MuJoCo ({backend})"
        failures.append(f"{backend}: {last[:120]}")
    stick_video(Trajectory.load(trajectory_file), load_config(RunConfig, config_file), path)
    return "no GL library loads (" + "; ".join(failures) + "): drew a stick animation"


def _in_child(backend: str, *words: str) -> tuple[int, str]:
    """Render in a process of its own, with a bar of its progress; exit code and last words."""
    with tempfile.TemporaryFile("w+") as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", "kjax.viz.video", *words],
            env={**os.environ, "MUJOCO_GL": backend},
            stdout=subprocess.PIPE, stderr=errors, text=True,
            close_fds=False,  # starts it without a fork, which JAX's threads do not bear
        )  # fmt: skip
        assert child.stdout is not None
        with tqdm(desc="video", unit="frame", leave=False, disable=None) as bar:
            for line in child.stdout:  # "FRAMES of ALL"
                done, _, total = line.partition(" of ")
                bar.total = int(total)
                bar.update(int(done) - bar.n)
        code = child.wait()
        errors.seek(0)
        return code, (errors.read().strip().splitlines() or ["no message"])[-1]


def render_video(run: Trajectory, config: RunConfig, path: Path) -> None:
    """Draw a run with MuJoCo's renderer, following the robot from its right side."""
    import mujoco

    from kjax.sim.resolve import build_scene

    model = build_scene(config)
    model.vis.quality.shadowsize, model.vis.quality.offsamples = SHADOW_MAP, 0
    model.vis.global_.offwidth, model.vis.global_.offheight = SIZE
    data = mujoco.MjData(model)
    renderer = mujoco.Renderer(model, height=SIZE[1], width=SIZE[0])
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    frames = _frames(run)
    with _writer(path) as writer:
        for done, i in enumerate(frames, 1):
            data.qpos[:], data.qvel[:] = run.qpos[i], run.qvel[i]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera="side")
            writer.append_data(_captioned(renderer.render(), run, i))
            if done % 10 == 0 or done == len(frames):
                print(f"{done} of {len(frames)}", flush=True)
    renderer.close()


def stick_video(run: Trajectory, config: RunConfig, path: Path) -> None:
    """Draw a run as a side view of lines: trunk, legs, ground, obstacles of the path left out."""
    sticks = _build_sticks(config)
    scale, ground = 620.0, 300.0  # pixels per metre; row of z = 0
    with _writer(path) as writer:
        for i in _frames(run):
            image = Image.new("RGB", SIZE, "white")
            draw = ImageDraw.Draw(image)

            def at(point: np.ndarray, centre: float = run.qpos[i, 0]) -> tuple[float, float]:
                return (SIZE[0] / 2 + scale * (point[0] - centre), ground - scale * point[1])

            draw.line([(0, ground), (SIZE[0], ground)], fill="#718096", width=2)
            for tick in np.arange(np.floor(run.qpos[i, 0]) - 1, run.qpos[i, 0] + 2, 0.1):
                x, _ = at(np.array([tick, 0.0]))
                draw.line([(x, ground), (x - 5, ground + 8)], fill="#a0aec0")
            trunk, legs = sticks(run.qpos[i])
            for leg, colour in _FAR_TO_NEAR.items():
                draw.line([at(p) for p in legs[leg]], fill=colour, width=5)
                x, y = at(legs[leg, 2])
                draw.ellipse([x - 8, y - 8, x + 8, y + 8], fill=colour)
            draw.line([at(p) for p in trunk], fill="#2d3748", width=22)
            writer.append_data(_captioned(np.asarray(image), run, i))


def _build_sticks(config: RunConfig) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Function qpos -> trunk ends (2, 2) and hip, knee, foot of each leg (4, 3, 2), (x, z) [m]."""
    import mujoco

    from kjax.sim.observe import find_addresses
    from kjax.sim.resolve import build_scene

    robot = get_robot(config.robot)
    model = build_scene(config, visual=False)
    data, at = mujoco.MjData(model), find_addresses(robot, model)
    bodies = [[model.joint(name).bodyid[0] for name in row[1:]] for row in robot.joints]

    def sticks(qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        legs = np.concatenate([data.xpos[bodies], data.geom_xpos[at.feet][:, None]], axis=1)
        hips = legs[:, 0].reshape(2, 2, 3).mean(axis=1)  # between the hips, front and rear
        overhang = 0.12 * (hips[0] - hips[1])
        trunk = np.stack([hips[0] + overhang, hips[1] - overhang])
        return trunk[:, ::2], legs[..., ::2]

    return sticks


def _writer(path: Path) -> Any:
    return imageio.get_writer(path, format="FFMPEG", mode="I", fps=FPS)


def _frames(run: Trajectory) -> np.ndarray:
    """Sample indices of the frames, ``FPS`` per second of simulated time."""
    return np.searchsorted(run.time, np.arange(0.0, run.time[-1], 1.0 / FPS))


def _captioned(frame: np.ndarray, run: Trajectory, i: int) -> np.ndarray:
    image = Image.fromarray(frame)
    text = (
        f"t = {run.time[i]:5.2f} s    v_x = {run.x[i, 3]:+.2f} m/s    "
        f"command {run.velocity_command[i]:+.2f} m/s"
    )
    ImageDraw.Draw(image).text((12, 10), text, fill=(30, 30, 30), font_size=15)
    return np.asarray(image)


def main() -> None:
    """Child process: TRAJECTORY CONFIG VIDEO."""
    trajectory_file, config_file, path = (Path(word) for word in sys.argv[1:4])
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        scratch = Path(folder) / path.name
        render_video(Trajectory.load(trajectory_file), load_config(RunConfig, config_file), scratch)
        scratch.replace(path)


if __name__ == "__main__":
    main()
