"""Tuning as a script: what it descends on, keeps, finds again and compares."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.runs.cache import Cache
from kjax.studies.tune import report, study
from kjax.studies.tune.options import parse_task
from kjax.tuning.space import build_space


@pytest.fixture(scope="module")
def small(repository):
    """Words of a tuning of seconds."""
    return (
        repository / "configs" / "trot_velocity_long.toml", "--seconds", "0.2", "--scenarios", "2",
        "--held-out", "2", "--updates", "5", "--worsen", "3", "--seeds", "2", "--duration", "0.6",
        "--command.times", "[0.0]", "--command.v_x", "[0.2]",
    )  # fmt: skip


@pytest.mark.slow
def test_a_tuning_leaves_a_config_a_verdict_and_pictures(call, small, tmp_path):
    box = ("--lmpc.friction", "inf", "--lmpc.torque_fraction", "inf")
    assert call(study.main, *small, *box, "--worsen", "10", "--out", tmp_path) == 0
    record = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert set(record["mujoco"]) == {"own", "start", "gradient"}
    assert all(entry["runs"] == 2 for entry in record["mujoco"].values())
    # The start counts among the points that the best is chosen from: only less than it says
    # that the descent descended.
    assert record["held_out_cost"]["gradient"] < record["held_out_cost"]["start"]
    assert record["descent"]["best_update"] > 0
    assert record["descent"]["updates"] == 5
    assert len(record["values"]["start"]["lmpc.Q"]) == 6
    assert {p.name for p in tmp_path.iterdir()} >= {"tuned.toml", "table.md", "figure.png"}
    tuned = load_config(RunConfig, tmp_path / "tuned.toml")
    assert list(tuned.lmpc.Q) == pytest.approx(record["values"]["gradient"]["lmpc.Q"])
    assert len(list((tmp_path / "cache").iterdir())) == 1


@pytest.fixture
def bowl(monkeypatch):
    """Stand in for closed loops: a cost that is least at the config's own parameters."""
    log = SimpleNamespace(tried=[])

    def build_objective(config, space, *, memory):
        def objective(variables, scenario):
            off = [jnp.sum((variables[key] - space.start[key]) ** 2) for key in space.start]
            return 1.0 + sum(off)

        return objective

    def verdict_of(config, overrides, seeds):
        log.tried.append(overrides)
        return {"runs": seeds, "falls": 0, "cost_median": 0.5,
                "velocity_rmse_mps": {"median": 0.02, "worst": 0.03, "n": seeds}}  # fmt: skip

    def traces(config, space, sets, scenarios):
        run = SimpleNamespace(
            x=np.zeros((40, 6)), wanted=np.zeros((40, 1)), alive=np.ones(40, bool)
        )
        return dict.fromkeys(sets, run)

    for stand_in in (build_objective, verdict_of, traces):
        monkeypatch.setattr(study, stand_in.__name__, stand_in)
    return log


def test_a_descent_comes_back_to_the_parameters_that_it_was_put_off(
    bowl, call, small, capsys, tmp_path
):
    words = (*small, "--updates", 60, "--out", tmp_path)
    assert call(study.main, *words) == 0
    record = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    costs = record["held_out_cost"]
    assert costs["own"] == pytest.approx(1.0)
    # Put off by a factor of 3: log(3)^2 for each of the six weights of Q and the one of R.
    assert costs["start"] == pytest.approx(1.0 + 7 * np.log(3.0) ** 2, rel=1e-3)
    assert costs["gradient"] < 1.2
    assert record["cost_over_own"]["gradient"] == pytest.approx(costs["gradient"])
    values = record["values"]
    np.testing.assert_allclose(values["gradient"]["lmpc.Q"], values["own"]["lmpc.Q"], rtol=0.3)
    off = np.array(values["start"]["lmpc.Q"]) / values["own"]["lmpc.Q"]
    np.testing.assert_allclose(np.maximum(off, 1.0 / off), 3.0, rtol=1e-6)
    assert [one["lmpc.Q"] for one in bowl.tried] == [
        values[name]["lmpc.Q"] for name in ("own", "start", "gradient")
    ]
    tuned = load_config(RunConfig, tmp_path / "tuned.toml")
    assert list(tuned.lmpc.Q) == pytest.approx(values["gradient"]["lmpc.Q"])
    text = (tmp_path / "table.md").read_text()
    assert "| own | 1.000 | 0 of 2 | 0.02 (0.03) | - | 0.500 |" in text
    assert (tmp_path / "figure.png").stat().st_size > 10_000
    # The same command finds the descent: no update is made again. Other speeds are another tuning,
    # and leave the first one.
    first = record["descent"]
    assert call(study.main, *words) == 0
    again = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))["descent"]
    assert again["cost"] == first["cost"]
    assert len(list((tmp_path / "cache").iterdir())) == 1
    assert call(study.main, *words, "--command.v_x", "[0.1]") == 0
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_descent_that_breaks_off_keeps_its_last_good_point_and_says_so(
    bowl, call, small, capsys, monkeypatch, tmp_path
):
    sound = study.descend

    def broken(*positional, **named):
        return sound(*positional, **named)._replace(healthy=False, stopped="cost is not finite")

    monkeypatch.setattr(study, "descend", broken)
    assert call(study.main, *small, "--out", tmp_path) == 2
    assert "the descent broke off: cost is not finite" in capsys.readouterr().err
    assert (tmp_path / "tuned.toml").exists()


def test_ctrl_c_is_exit_code_130(bowl, call, small, capsys, monkeypatch, tmp_path):
    def interrupted(*positional, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr(study, "descend", interrupted)
    assert call(study.main, *small, "--out", tmp_path) == 130
    assert "the same command goes on" in capsys.readouterr().err


@pytest.fixture
def evolution(monkeypatch, repository, tmp_path):
    """CMA-ES on stand-ins: the cost of a candidate is how far its weights are off."""
    pytest.importorskip("cma")
    config = load_config(RunConfig, repository / "configs" / "trot_velocity_long.toml")
    space = build_space(config, ("lmpc.Q",))
    log = SimpleNamespace(asked=[], stop_at=None)

    class Engine:
        def __init__(self, spec, torques):
            assert torques == "held"

        def run(self, configs):  # not resolved, see below
            if len(log.asked) == log.stop_at:
                return SimpleNamespace(interrupted=True)
            log.asked.append([one.lmpc.Q for one in configs])
            return SimpleNamespace(interrupted=False, configs=configs)

    def costs(recording):
        weights = np.log([one.lmpc.Q for one in recording.configs])
        return ((weights - np.log(config.lmpc.Q)) ** 2).sum(axis=1)

    monkeypatch.setattr(study, "BatchEngine", Engine)
    monkeypatch.setattr(study, "resolve_episodes", list)
    monkeypatch.setattr(study, "recording_costs", costs)
    args = SimpleNamespace(speeds=(0.0, 0.3), seconds=0.2, pieces=2)
    begin = study.worsened(space, 2.0, 0)

    def evolve(folder, stop_at):
        log.asked.clear()
        log.stop_at = stop_at
        cache = Cache(tmp_path / folder)
        try:
            study.evolve(config, space, begin, args, 1e6, cache, "key")
        except KeyboardInterrupt:
            return list(log.asked), cache.arrays("key")
        raise AssertionError("it was to be interrupted")

    return evolve


def test_an_evolution_that_was_interrupted_goes_on_as_if_it_had_not_been(evolution):
    whole, kept = evolution("whole", 5)
    assert kept["costs"].shape == (5, len(whole[0]) // study.POPULATION_SEEDS)
    first, _ = evolution("cut", 3)
    rest, again = evolution("cut", 2)
    assert first + rest == whole
    np.testing.assert_array_equal(again["costs"], kept["costs"])
    best = kept["costs"].min(axis=1)
    assert best[-1] < best[0]  # it searches


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--keys", "lmpc.weights"], "--keys: 'lmpc.weights' is no variable"),
        (["--scenarios", "0"], "--scenarios: got 0, wanted more than 0"),
        (["--sim.base", "free"], "wanted 'planar'"),
        (["--worsn", "3"], "did you mean --worsen"),
        (["--keys", "spatial.force"], "'spatial.force' has no effect with controller = 'planar'"),
    ],
    ids=["key", "count", "base", "option", "other controller"],
)
def test_a_mistake_is_one_line(call, repository, capsys, tmp_path, words, text):
    config = repository / "configs" / "trot_velocity.toml"
    assert call(study.main, config, *words, "--out", tmp_path) == 2
    err = capsys.readouterr().err
    assert text in err
    assert len(err.strip().splitlines()) == 1


def test_in_three_dimensions_speeds_keys_and_the_table_are_those_of_its_controller(
    repository, capsys, call, tmp_path
):
    config = repository / "configs" / "omni_trot.toml"
    _, task = parse_task([str(config)], "title")
    assert task.speeds == ((-0.4, 0.0, -1.0), (0.8, 0.3, 1.5))
    assert {"spatial.attitude", "lateral.foothold_gain", "leg.foothold_gain"} <= set(task.keys)
    episodes = study.mujoco_scenarios(load_config(RunConfig, config), task)
    assert all(len(one.command.yaw_rate) == task.pieces for one in episodes)
    for column, low, high in zip(("v_x", "v_y", "yaw_rate"), *task.speeds, strict=True):
        drawn = np.array([getattr(one.command, column) for one in episodes])
        assert (drawn >= low).all()
        assert (drawn <= high).all()
    assert call(study.main, config, "--keys", "lmpc.Q", "--out", tmp_path) == 2
    assert "'lmpc.Q' has no effect with controller = 'spatial'" in capsys.readouterr().err
    told = {"median": 0.1, "worst": 0.2}
    entry = {"runs": 1, "falls": 0, "cost_median": 1.0, "roll_p95_deg": told}
    text = report.table({"mujoco": {"own": entry}, "held_out_cost": {"own": 2.0}})
    assert "roll, 95 % [deg]" in text
    assert "v_y" not in text
