"""Recordings are taken from the folder where they would come out the same, and else made."""

from types import SimpleNamespace

import numpy as np
import pytest

from kjax.studies.whole_body import recordings


@pytest.fixture
def record(monkeypatch, tmp_path):
    """Record a kind of episodes with a stand-in for the engine; returns how many it recorded."""
    count = []

    class Engine:
        def __init__(self, config, torques):
            pass

        def run(self, configs):
            count.append(len(configs))
            shape = (20, len(configs))
            log = SimpleNamespace(
                x=np.zeros((*shape, 6)), feet=np.zeros((*shape, 4, 2)),
                force=np.zeros((*shape, 4, 2)), stance=np.ones((*shape, 4), bool),
                foot_force=np.zeros((*shape, 4)),
            )  # fmt: skip
            ticks, fell = np.full(len(configs), 20), np.zeros(len(configs), bool)
            return SimpleNamespace(interrupted=False, log=log, ticks=ticks, fell=fell)

    monkeypatch.setattr("kjax.sim.engines.mujoco_batch.BatchEngine", Engine)

    def call(*, robots=3, kind="trot"):
        count.clear()
        args = SimpleNamespace(robots=robots, duration=3.0, force=15.0)
        assert len(recordings.record(kind, args, tmp_path)) == robots
        return sum(count)

    return call


def test_recordings_are_found_again(record):
    assert record() == 3
    assert record() == 0


def test_with_other_code_or_another_config_it_is_recorded_and_the_first_stays(record, monkeypatch):
    record()
    with monkeypatch.context() as other:
        other.setattr("kjax.runs.cache.code_version", lambda *files: "other")
        assert record() == 3
    assert record(robots=4) == 4
    assert record() == 0


@pytest.mark.parametrize("length", [0, 10, 1000])
def test_a_recording_that_is_cut_off_is_named(record, capsys, tmp_path, length):
    record()
    (path,) = (tmp_path / "cache").iterdir()
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(SystemExit) as caught:
        record()
    assert caught.value.code == 2
    assert f"{path}: damaged" in capsys.readouterr().err
