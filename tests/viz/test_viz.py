import dataclasses

import imageio.v2 as imageio
import numpy as np
import pytest

from kjax import cli
from kjax.config import RunConfig, load_config
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.resolve import batch_spec, resolve_episode
from kjax.viz import plots, video


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    config = load_config(RunConfig, None, {"duration": 0.6})
    run = simulate(MujocoEngine(batch_spec(config)), resolve_episode(config))
    run.save(folder / "trajectory.npz")
    cli.save_config(folder / "config.toml", config)
    return folder, run, config


def frames(path):
    with imageio.get_reader(path) as reader:
        return np.stack([frame for frame in reader])


def test_the_figure_has_ink(saved):
    folder, run, config = saved
    plots.closed_loop_figure(run, config, folder / "figure.png")
    picture = imageio.imread(folder / "figure.png")
    assert picture.shape[0] > 500
    assert picture[..., :3].std() > 10


def test_the_figure_knows_the_height_and_the_stride_of_the_gait_that_is_walked(
    saved, tmp_path, monkeypatch
):
    """A bound's own height, and its cycle of 0.1 + 0.1 + 0.05 + 0.1 s."""
    _, run, _ = saved
    drawn = {}
    close = plots.plt.close

    def look(fig):
        drawn["height"] = fig.axes[2].lines[1].get_ydata()
        close(fig)

    monkeypatch.setattr(plots.plt, "close", look)
    bound = load_config(RunConfig, None, {"gaits.bound.body_height": 0.7})
    half = np.arange(len(run.time)) >= len(run.time) // 2
    switched = dataclasses.replace(run, gait=np.where(half, 1, 0))
    plots.closed_loop_figure(switched, bound, tmp_path / "figure.png")
    np.testing.assert_allclose(drawn["height"], 0.426 * np.where(half, 0.7, 0.6338), rtol=1e-14)
    assert plots.stride_time(switched.gait[half], bound) == pytest.approx(0.35)
    assert plots.stride_time(switched.gait[~half], bound) == pytest.approx(0.5)


def test_a_moving_mean_of_a_line_is_that_line():
    line = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(plots.moving_mean(line, 5)[5:-5], line[5:-5], atol=1e-12)


def test_the_stick_animation_moves(saved):
    folder, run, config = saved
    video.stick_video(run, config, folder / "stick.mp4")
    images = frames(folder / "stick.mp4")
    assert len(images) == pytest.approx(0.6 * video.FPS, abs=2)
    assert np.abs(images[0].astype(int) - images[-1]).max() > 50


def test_without_a_gl_library_the_stick_animation_steps_in_and_says_so(saved, monkeypatch):
    folder, _, _ = saved
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    said = video.save_video(
        folder / "trajectory.npz", folder / "config.toml", folder / "fallback.mp4"
    )
    assert "stick animation" in said
    assert len(frames(folder / "fallback.mp4")) > 5


@pytest.mark.slow
def test_mujocos_renderer_draws_the_robot_where_a_gl_library_loads(saved):
    folder, _, _ = saved
    said = video.save_video(folder / "trajectory.npz", folder / "config.toml", folder / "video.mp4")
    if "stick" in said:
        pytest.skip(said)
    images = frames(folder / "video.mp4").astype(int)
    assert np.abs(images[0] - images[-1]).max() > 50
    assert images[0].std() > 10
