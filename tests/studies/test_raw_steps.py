"""The study of raw steps: what it calls met, and what a quick call leaves."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from kjax.studies import raw_steps


def test_raw_steps_count_what_is_over_the_limit_and_name_the_seed(engine, tmp_path):
    engine.pitch = lambda config: 6.0 if config.seed == 1 else 2.0
    words = ["--seeds", "3", "--gaits", "trot", "--bases", "free", "--out", str(tmp_path)]
    assert raw_steps.main(words) == 0
    rows = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["steps"]
    assert {row["forces"] for row in rows} == {"rows", "box"}
    for row in rows:
        small = row["size_mps"] <= 0.6
        assert row["pitch_limit_deg"] == (5.0 if small else 8.0)
        assert (row["pitch_over"], row["met"]) == ((1, False) if small else (0, True))
        assert (row["pitch_max_deg"], row["worst_seed"]) == (6.0, 1)
    assert all(np.isinf(config.lmpc.command_slew) for config in engine.count)
    times = {config.command.times[-1] for config in engine.count if config.seed == 0}
    assert len(times) == 2  # one phase per seed, from either speed


def test_what_a_step_did_is_measured_from_the_step_on():
    args = SimpleNamespace(seeds=1, quick=True)
    case = raw_steps.Setting(gait="trot", base="planar", forces="rows")
    _, configs = next(raw_steps.steps_of(case, 0.0, args))
    model, _ = raw_steps._scene("go1", "planar", "all")
    time = np.arange(0.0, 1.2, 0.005)
    x, qpos = np.zeros((len(time), 6)), np.zeros((len(time), model.nq))
    qpos[:, 1] = 1.0
    qpos[10, 1] = 0.0  # the body in the ground, 0.05 s after the start
    begin = configs[0].command.times[-1]
    x[:, 2] = np.where(time < begin - 1e-9, 0.5, -0.1)
    found = raw_steps.after_step(SimpleNamespace(time=time, x=x, qpos=qpos), configs[0])
    assert found["step_pitch_max_deg"] == pytest.approx(np.degrees(0.1))
    assert found["body_contact_ticks"] == 1
    assert found["body_contact_time_s"] == pytest.approx(0.05)
