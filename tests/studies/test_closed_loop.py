"""The main script in this process, with stand-ins for what takes long."""

import json
from types import SimpleNamespace

import pytest

from kjax.studies import closed_loop, sweep


@pytest.fixture
def engine(monkeypatch, standing_run):
    """Stand in for the engine: runs stand still for ``seconds``, interrupted if ``interrupted``."""
    engine = SimpleNamespace(seconds=2.0, interrupted=False, compiled=0, episodes=0)

    def build(spec):
        engine.compiled += 1
        return SimpleNamespace(program=lambda config: None)

    def simulate(_, config, **more):
        engine.episodes += 1
        return standing_run(config, engine.seconds, interrupted=engine.interrupted)

    monkeypatch.setattr(closed_loop, "MujocoEngine", build)
    monkeypatch.setattr(closed_loop, "resolve_episode", lambda config: config)
    monkeypatch.setattr(closed_loop, "simulate", simulate)
    monkeypatch.setattr(
        "kjax.viz.plots.closed_loop_figure",
        lambda run, config, path, title="": path.write_text(title),
    )
    return engine


def test_an_interrupted_run_says_when_and_shows_no_metrics(engine, call, capsys, tmp_path):
    engine.interrupted = True
    assert call(closed_loop.main, "--duration", 20.0, "--out", tmp_path) == 130
    out = capsys.readouterr().out
    assert "interrupted at 2.00 s of 20 s" in out
    assert "RMSE" not in out
    assert "s in all" not in out
    kept = json.loads((tmp_path / "metrics.json").read_text())
    assert kept == {
        "interrupted": True, "simulated_s": 2.0, "fell": False, "fall_time_s": None
    }  # fmt: skip
    assert "interrupted at 2.00 s" in (tmp_path / "figure.png").read_text()
    assert (tmp_path / "trajectory.npz").exists()


def test_a_whole_run_shows_its_metrics(engine, call, capsys, tmp_path):
    assert call(closed_loop.main, "--duration", 2.0, "--out", tmp_path) == 0
    out = capsys.readouterr().out
    assert "velocity RMSE" in out
    assert "interrupted" not in out
    assert json.loads((tmp_path / "metrics.json").read_text())["velocity_rmse_mps"] == 0.0


def test_a_run_too_short_for_metrics_says_so(engine, call, capsys, tmp_path):
    engine.seconds = 0.3
    assert call(closed_loop.main, "--duration", 0.3, "--out", tmp_path) == 0
    assert "no metrics: the first 0.5 s" in capsys.readouterr().out


def test_an_interrupted_seed_is_not_kept(engine, call, capsys, tmp_path):
    words = ("--duration", 2.0, "--out", tmp_path, "--seeds", 2)
    engine.interrupted = True
    assert call(closed_loop.main, *words) == 130
    assert "interrupted in seed 0 at 2.00 s of 2 s" in capsys.readouterr().out
    assert not (tmp_path / "seeds.json").exists()
    engine.interrupted = False
    assert call(closed_loop.main, *words) == 0
    assert "2 runs, 0 falls" in capsys.readouterr().out


def test_seeds_go_on_where_they_stopped(engine, call, capsys, tmp_path):
    words = ("--duration", 2.0, "--out", tmp_path, "--seeds")
    assert call(closed_loop.main, *words, 1) == 0
    first = json.loads((tmp_path / "seeds.json").read_text())
    assert call(closed_loop.main, *words, 2) == 0
    both = json.loads((tmp_path / "seeds.json").read_text())
    assert both["seeds"]["0"] == first["seeds"]["0"]
    assert set(both["seeds"]) == {"0", "1"}
    assert both["runs"] == engine.episodes == 2
    assert "2 runs, 0 falls" in capsys.readouterr().out


def test_seeds_of_another_config_walk_anew_and_finished_ones_stay(engine, call, capsys, tmp_path):
    def seeds():
        return json.loads((tmp_path / "seeds.json").read_text())

    words = ("--out", tmp_path, "--seeds", 2, "--duration")
    assert call(closed_loop.main, *words, 2.0) == 0
    before = seeds()
    assert list(before["seeds"]) == ["0", "1"]
    engine.episodes = 0
    engine.seconds = 3.0
    assert call(closed_loop.main, *words, 3.0) == 0
    assert engine.episodes == 2
    assert seeds()["seeds"]["0"]["simulated_s"] == 3.0
    engine.episodes = 0
    assert call(closed_loop.main, *words, 2.0) == 0
    assert engine.episodes == 0  # the first ones are there still
    assert seeds()["seeds"] == before["seeds"]
    assert call(closed_loop.main, *words, 2.0, "--restart") == 0
    assert engine.episodes == 2


def test_a_view_without_a_display_is_refused_before_anything_is_compiled(
    engine, call, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr("glfw.init", lambda: False)
    assert call(closed_loop.main, "--view", "--out", tmp_path / "run") == 2
    assert "no window can be opened here" in capsys.readouterr().err
    assert engine.compiled == 0
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--view", "--seeds", 2), "--view: shows a single run"),
        (("--restart",), "--restart: belongs to --seeds"),
        (("--duration", 0.001), "duration is 0.001 s, shorter than lmpc.control_dt"),
        (("--seeds", 0), "--seeds: got 0, wanted at least 1"),
        (("--lmpc.horizon", 0), "greater than 0"),
        (("--out", "/dev/null/x"), "cannot be written"),
    ],
)
def test_options_that_cannot_be_or_contradict_each_other_are_one_line(
    engine, call, capsys, words, said
):
    assert call(closed_loop.main, *words) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said in err
    assert engine.compiled == 0


@pytest.mark.parametrize(
    ("main", "other"),
    [(closed_loop.main, "sweeps/push_trot.toml"), (sweep.main, "trot_velocity.toml")],
    ids=["closed_loop", "sweep"],
)
def test_a_config_of_another_kind_is_one_line_and_exit_code_2(
    call, capsys, repository, main, other
):
    assert call(main, repository / "configs" / other) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "which experiments/" in err
