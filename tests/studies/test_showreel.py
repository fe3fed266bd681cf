"""The moving picture: what is cut from a recording, and what is written."""

import dataclasses
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

from kjax.studies import showreel


@dataclasses.dataclass
class Recorded:
    time: np.ndarray
    qpos: np.ndarray
    fell: bool = False
    dt: float = 0.1


def test_a_part_of_a_recording_begins_at_zero_and_keeps_what_has_no_time():
    time = np.linspace(0.0, 1.0, 11)
    run = Recorded(time=time, qpos=np.stack([time, -time], axis=1))
    part = showreel.between(run, 0.2, 0.55)
    np.testing.assert_allclose(part.time, [0.0, 0.1, 0.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(part.qpos[:, 0], [0.2, 0.3, 0.4, 0.5])
    assert (part.fell, part.dt) == (False, 0.1)


def test_the_picture_moves_at_the_pace_of_the_walk_and_is_small(tmp_path, monkeypatch, capsys):
    frames = [Image.new("RGB", showreel.SIZE, (i, 2 * i, 90)) for i in range(0, 80, 4)]
    showreel.save(frames, tmp_path / "a.gif")
    picture = Image.open(tmp_path / "a.gif")
    assert picture.n_frames == len(frames) // showreel.EVERY
    assert picture.info["duration"] == 1000 * showreel.EVERY / showreel.FPS
    monkeypatch.setattr(showreel, "LIMIT", 10)
    with pytest.raises(SystemExit):
        showreel.save(frames, tmp_path / "a.gif")
    assert "wanted less than" in capsys.readouterr().err


def test_every_clip_is_shown_with_its_caption(call, tmp_path, monkeypatch):
    """With stand-ins for simulator and renderer."""
    walked = []

    def simulate(engine, episode):
        walked.append(episode)
        time = np.arange(0.0, episode.goal.duration, 0.1)
        return Recorded(time=time, qpos=np.zeros((len(time), 19)))

    def save_video(trajectory, config, path):
        frame = np.full((368, 640, 3), 200, np.uint8)
        imageio.mimwrite(path, [frame] * 4, format="FFMPEG", fps=20)
        return "drawn"

    monkeypatch.setattr(showreel, "MujocoEngine", lambda spec: None)
    monkeypatch.setattr(showreel, "simulate", simulate)
    monkeypatch.setattr(showreel, "save_video", save_video)
    monkeypatch.setattr(Recorded, "save", lambda self, path: Path(path).touch(), raising=False)
    clip = showreel.CLIPS[0]
    frames = list(showreel.film(clip, tmp_path))
    assert len(frames) == 4
    assert walked[0].goal.duration == clip.end
    corner = np.asarray(frames[0])[:30, :150]
    assert corner.min() < 100  # the caption is dark
    assert np.asarray(frames[0])[100:].min() > 150
