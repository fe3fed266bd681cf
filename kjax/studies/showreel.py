"""The moving picture of the README: every gait and ground that is listed here, one after another.

Leaves showreel.gif in the output folder. A new gait joins it by a line of ``CLIPS``.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw

from kjax import cli
from kjax.config import RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.options import Options, fail, parse
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.resolve import batch_spec, resolve_episode
from kjax.sim.trajectory import Trajectory
from kjax.viz.video import FPS, save_video

SIZE = (384, 216)  # pixels of the picture
CROP = (96, 76, 544, 328)  # of a frame of the video: the robot fills it
EVERY = 2  # of the video's frames
COLOURS = 40
LIMIT = 3_000_000  # bytes


@dataclass(frozen=True)
class Clip:
    """A walk, the part of it that is shown [s], and what is said of it."""

    config: str
    caption: str
    begin: float
    end: float
    keys: dict[str, Any] = dataclasses.field(default_factory=dict)


STEADY = {"command.times": [0.0], "lmpc.command_slew": 1.0, "sim.base": "free"}
CLIPS: tuple[Clip, ...] = (
    Clip("trot_velocity_long", "trot, 0.6 m/s", 1.5, 3.0, STEADY | {"command.v_x": [0.6]}),
    Clip("bound_multiphase", "bound, 0.8 m/s", 2.5, 4.5, STEADY | {"command.v_x": [0.8]}),
    Clip("bound_to_trot", "bound to trot, in flight", 2.2, 4.2, {"sim.base": "free"}),
    Clip("trot_rough", "trot over blocks of 5 to 7 cm", 4.5, 7.0, {"sim.base": "free"}),
    Clip("bound_rough", "bound over them", 2.2, 4.7, {"sim.base": "free"}),
    Clip("omni_trot", "ahead, to the left, turning", 7.5, 9.9),
    Clip("slope", "a slope of 20 degrees, unseen", 3.4, 5.2),
    Clip("stairs", "steps of 8 cm, unseen", 4.0, 6.0),
    Clip("pronk", "pronk", 2.0, 3.2, {"sim.base": "free"}),
)


@dataclass(kw_only=True)
class ShowreelOptions(Options):
    """Options of the picture."""

    quick: bool = False
    """One clip of half a second: to check the script."""


def main(argv: Sequence[str] | None = None) -> int:
    """Record, render, assemble."""
    args = parse(ShowreelOptions, argv, __doc__.splitlines()[0])
    cli.configure_jax(one_core=True)
    folder = cli.output_folder(args, "showreel")
    clips = CLIPS
    if args.quick:
        clips = (dataclasses.replace(CLIPS[0], begin=0.2, end=0.7),)
    frames: list[Image.Image] = []
    for clip in clips:
        frames += film(clip, folder)
    path = folder / "showreel.gif"
    save(frames, path)
    print(f"{path}: {len(frames)} frames, {path.stat().st_size / 1e6:.2f} MB")
    return 0


def film(clip: Clip, folder: Path) -> Iterator[Image.Image]:
    """Frames of a clip, with its caption."""
    keys = clip.keys | {"duration": clip.end}
    config = load_config(RunConfig, shipped_config(clip.config), keys)
    run = simulate(MujocoEngine(batch_spec(config)), resolve_episode(config))
    if run.fell:
        fail(f"{clip.config}: fell; nothing to show")
    shown = between(run, clip.begin, clip.end)
    names = [folder / f"{clip.config}{end}" for end in (".npz", ".toml", ".mp4")]
    shown.save(names[0])
    cli.save_config(names[1], config)
    print(f"{clip.caption}: {save_video(*names)}", flush=True)
    for frame in imageio.get_reader(names[2]).iter_data():
        yield captioned(np.asarray(frame), clip.caption)


def between(run: Trajectory, begin: float, end: float) -> Trajectory:
    """The part of a recording between two times [s]."""
    part = slice(*np.searchsorted(run.time, (begin, end)))
    changes = {
        field.name: getattr(run, field.name)[part]
        for field in dataclasses.fields(run)
        if np.ndim(getattr(run, field.name)) and len(getattr(run, field.name)) == len(run.time)
    }
    shifted = changes | {"time": changes["time"] - changes["time"][0]}
    return dataclasses.replace(run, **shifted)


def captioned(frame: np.ndarray, text: str) -> Image.Image:
    """A frame cut to the robot, with the caption in its corner."""
    image = Image.fromarray(frame).crop(CROP).resize(SIZE, Image.Resampling.LANCZOS)
    ImageDraw.Draw(image).text((10, 8), text, fill=(30, 30, 30), font_size=15)
    return image


def save(frames: Sequence[Image.Image], path: Path) -> None:
    """Write a GIF with one palette for all frames."""
    frames = frames[::EVERY]
    sample = np.concatenate([np.asarray(frame) for frame in frames[:: max(1, len(frames) // 8)]])
    palette = Image.fromarray(sample).quantize(COLOURS)
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], loop=0, optimize=True,
                  duration=1000 * EVERY / FPS)  # fmt: skip
    if path.stat().st_size > LIMIT:
        fail(f"{path}: {path.stat().st_size / 1e6:.1f} MB, wanted less than {LIMIT / 1e6:g}")


if __name__ == "__main__":
    cli.run(main)
