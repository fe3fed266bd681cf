"""The studies on invariance and raw steps: what they call met, and what a quick call leaves."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from kjax.runs.batches import batch_key
from kjax.studies import invariance, raw_steps


@pytest.fixture
def walked(monkeypatch):
    """Stand in for the engine: no walking, one row of metrics for every config; counts them."""
    count = []

    def run(cache, configs, *, torques, dtype=np.float64, measure=None, **more):
        for config in configs:
            key = batch_key(cache, config, torques, dtype, measure)
            if key not in cache:
                count.append(config)
                cache.add({key: row(config)})

    def row(config):
        out = {"fell": False, "velocity_rmse_mps": 0.02 + walked.error(config), "qp_unsolved": 0}
        return out | {
            "step_time_s": config.command.times[-1], "step_pitch_max_deg": walked.pitch(config),
            "step_pitch_at_s": 1.2, "body_contact_ticks": 0,
        }  # fmt: skip

    walked = SimpleNamespace(count=count, error=lambda config: 0.0, pitch=lambda config: 2.0)
    for module in (invariance, raw_steps):
        monkeypatch.setattr(module, "run_batch", run)
        monkeypatch.setattr(module.cli, "configure_jax", lambda **more: None)
    return walked


def study(folder, *words):
    words = ["--models", "srb", "--gaits", "trot", "--out", str(folder), *words]
    assert invariance.main(words) == 0
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))["parts"]


def test_the_cells_differ_in_where_zero_is_and_in_nothing_else(walked, tmp_path):
    parts = study(tmp_path)
    assert [(one["check"], len(one["cells"])) for one in parts] == [
        ("place", 16), ("float32", 12), ("heading", 3),
    ]  # fmt: skip
    assert all(one["met"] and one["largest"] == 0.0 for one in parts)
    places = {(c.sim.start[0], c.sim.floor) for c in walked.count if c.sim.base == "planar"}
    assert len(places) == 16
    assert {c.sim.heading for c in walked.count if c.sim.base == "free"} == {0.0, 1.0, 2.0}
    assert all(c.sim.cone == "elliptic" for c in walked.count if c.sim.base == "free")
    assert (tmp_path / "figure.png").exists()


def test_a_cell_that_walks_otherwise_is_named_and_not_met(walked, tmp_path):
    walked.error = lambda config: 1e-3 * (config.sim.start[0] == 1e4)
    place, single, _ = study(tmp_path)
    assert place["met"] is False
    assert place["largest"] == pytest.approx(0.05)
    assert place["largest_at"][0] == 1e4
    assert single["met"] is True  # it goes to 1 km
    assert "| NO |" in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_finished_batches_are_not_run_again_and_other_parts_stay_on_the_page(walked, tmp_path):
    study(tmp_path, "--checks", "place")
    before = len(walked.count)
    parts = study(tmp_path, "--checks", "heading")
    assert len(walked.count) == before + 3
    assert [one["check"] for one in parts] == ["place", "heading"]


def test_raw_steps_count_what_is_over_the_limit_and_name_the_seed(walked, tmp_path):
    walked.pitch = lambda config: 6.0 if config.seed == 1 else 2.0
    words = ["--seeds", "3", "--gaits", "trot", "--bases", "free", "--out", str(tmp_path)]
    assert raw_steps.main(words) == 0
    rows = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["steps"]
    assert {row["forces"] for row in rows} == {"rows", "box"}
    for row in rows:
        small = row["size_mps"] <= 0.6
        assert row["pitch_limit_deg"] == (5.0 if small else 8.0)
        assert (row["pitch_over"], row["met"]) == ((1, False) if small else (0, True))
        assert (row["pitch_max_deg"], row["worst_seed"]) == (6.0, 1)
    assert all(np.isinf(config.lmpc.command_slew) for config in walked.count)
    times = {config.command.times[-1] for config in walked.count if config.seed == 0}
    assert len(times) == 2  # one phase per seed, from either speed


@pytest.mark.parametrize("words", [["--seeds", "0"], ["--gaits", "walk"], ["--residual", "none"]])
def test_a_mistake_is_one_line_and_exit_code_2(walked, capsys, words):
    with pytest.raises(SystemExit) as caught:
        invariance.main(words)
    assert caught.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_a_step_did_is_measured_from_the_step_on():
    args = SimpleNamespace(seeds=1, quick=True)
    case = raw_steps.Case(gait="trot", base="planar", forces="rows")
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
