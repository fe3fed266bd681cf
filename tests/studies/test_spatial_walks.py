"""Models in closed loop, tuned alike: what is asked of them, kept, measured and said."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.runs.batches import batch_key
from kjax.sim.resolve import batch_spec
from kjax.studies.spatial_walks import cases, report, study, tuning
from kjax.studies.spatial_walks.cases import CASES, SpatialWalksOptions

pytest.importorskip("cma")
# Stand-in for physics: the weights, as logs over the shipped ones, that would be best.
WANTED = np.array([0.8, -0.9, 0.0, 0.5, 0.0, 1.0, -0.6, 0.9, 0.4])


def bowl(config):
    """Cost of a config: how far its weights are off, more for the convex model."""
    off = tuning.logs_of(config) - tuning.logs_of(load_config(RunConfig)) - WANTED
    return float(1.0 + (off**2).sum() + (config.spatial.model == "convex"))


def row(config):
    """A pushed momentum model falls with every other seed."""
    fell = config.spatial.model == "momentum" and config.push.forward > 0 and config.seed % 2 == 1
    return {
        "fell": fell, "cost": bowl(config), "errors": None if fell else [0.01, 0.02, 0.03],
        "errors_of_cycles": [0.001, 0.002, 0.003], "tilt_p95_deg": [0.5, 1.0],
        "largest_tilt_deg": None if fell else 7.5,
    }  # fmt: skip


@pytest.fixture
def walks(monkeypatch):
    """No physics; lists the episodes of tuning and of reports."""
    log = SimpleNamespace(tuning=[], reports=[], stop_at=None)

    class Engine:
        def __init__(self, spec, torques, threads):
            assert torques == "held"

        def run(self, configs):  # not resolved, see below
            assert len({batch_spec(config) for config in configs}) == 1
            is_over = log.stop_at is not None and len(log.tuning) >= log.stop_at
            log.tuning += [] if is_over else configs
            return SimpleNamespace(interrupted=is_over, trajectory=lambda robot: None)

    def run(cache, configs, *, torques, dtype, measure, **more):
        assert len({(batch_spec(config), config.duration) for config in configs}) == 1
        keys = [batch_key(cache, config, torques, dtype, measure) for config in configs]
        for key, config in zip(keys, configs, strict=True):
            if key not in cache:
                log.reports.append(config)
                cache.add({key: row(config)})
        return [cache[key] for key in keys]

    monkeypatch.setattr(tuning, "BatchEngine", Engine)
    monkeypatch.setattr(tuning, "resolve_episodes", list)
    monkeypatch.setattr(tuning, "observed", lambda run, config: {"cost": bowl(config)})
    monkeypatch.setattr(study, "run_batch", run)
    monkeypatch.setattr(study.cli, "configure_jax", lambda **more: None)
    return log


@pytest.fixture
def words(tmp_path):
    """A small study; a pushed case, a steady one, and one of another program."""
    return (
        "--models", "momentum", "convex", "--cases", "steady", "pushed", "bound",
        "--generations", "5", "--population", "6", "--seeds", "2", "--out", str(tmp_path),
    )  # fmt: skip


def test_every_model_has_one_budget_other_seeds_and_is_kept(walks, words, tmp_path):
    assert study.main(words) == 0
    tried = [config.spatial.model for config in walks.tuning]
    assert tried.count("momentum") == tried.count("convex") == 5 * 6 * len(cases.STEADY)
    assert not {c.seed for c in walks.tuning} & {c.seed for c in walks.reports}
    before = len(walks.tuning), len(walks.reports)
    assert study.main(words) == 0
    assert (len(walks.tuning), len(walks.reports)) == before
    record = json.loads((tmp_path / "results.json").read_text())
    assert list(record["models"]) == ["momentum", "convex"]
    for entry in record["models"].values():
        costs = entry["tuning_cost"]
        assert costs["best"] < costs["shipped"]
        assert len(costs["of_generations"]) == 5
        # The weights that report are those of the cheapest candidate.
        assert entry["tuned"]["bound"]["cost"] == pytest.approx(costs["best"])
        assert entry["shipped"]["bound"]["cost"] == pytest.approx(costs["shipped"])
    falls = record["models"]["momentum"]["tuned"]["pushed"]["falls"]
    assert (falls["count"], falls["episodes"]) == (cases.PHASES, 4 * cases.PHASES)
    low, high = falls["interval"]
    assert low < 0.25 < high
    text = (tmp_path / "table.md").read_text()
    assert "| momentum | tuned | 8 of 32 | 13 to 42 | 7.5 (7.5 to 7.5) |" in text
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_an_interrupted_tuning_goes_on_as_if_it_had_not_been(walks, words, capsys):
    per_generation = 6 * len(cases.STEADY)
    walks.stop_at = 3 * per_generation
    assert study.main(words) == 130
    assert "the same command goes on" in capsys.readouterr().out
    assert len(walks.tuning) == 3 * per_generation
    walks.stop_at = None
    assert study.main(words) == 0
    tried = [config.spatial.model for config in walks.tuning]
    assert tried.count("momentum") == 5 * per_generation


def test_a_quick_call_goes_through_every_case(walks, tmp_path):
    assert study.main(["--quick", "--out", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["cases"] == list(CASES)
    assert len(record["models"]) == 2
    assert "this is no result" in (tmp_path / "table.md").read_text()


def test_a_model_that_does_not_exist_is_refused(capsys):
    with pytest.raises(SystemExit):
        study.main(["--models", "linear"])
    assert "momentum, convex, present" in capsys.readouterr().err


def test_weights_are_positive_multiples_and_those_of_place_and_v_z_stay():
    one = cases.walk_config("present", (1.0, 0.0, 0.0), 1.0)
    logs = tuning.logs_of(one)
    assert tuning.weighted(one, logs).spatial.attitude == pytest.approx(one.spatial.attitude)
    other = tuning.weighted(one, logs + WANTED).spatial
    np.testing.assert_allclose(
        np.log(other.attitude) - np.log(one.spatial.attitude), WANTED[:3], atol=1e-12
    )
    np.testing.assert_allclose(np.log(other.force / one.spatial.force), WANTED[8], atol=1e-12)
    assert other.position == one.spatial.position
    assert other.velocity[2] == one.spatial.velocity[2]
    assert other.model == "present"


def test_pushes_go_ahead_and_sideways_at_the_phases_of_a_cycle():
    configs = CASES["pushed"].configs("edmd", SpatialWalksOptions(push_seeds=3))
    assert len(configs) == 2 * cases.PHASES * 3
    forces = {(c.push.forward, c.push.lateral) for c in configs}
    assert forces == {(cases.IMPULSE, 0.0), (0.0, cases.IMPULSE)}
    begins = np.unique([c.push.times[0] for c in configs])
    assert len(begins) == cases.PHASES
    assert begins[-1] - begins[0] < configs[0].gaits["trot"].period


def test_a_fall_costs_more_than_any_walk_and_an_error_of_a_unit_costs_one():
    walk = {
        "errors": [0.02, 0.0, 9.0], "errors_of_cycles": [9.0, 9.0, 0.02],
        "tilt_p95_deg": [0.0, 2.0],
    }  # fmt: skip
    assert cases.cost(walk) == pytest.approx(1 + 1 + 4)
    assert cases.cost({"errors": None}) == cases.FALL
    assert cases.cost(walk | {"errors": [9.0, 0.0, 0.0]}) == cases.FALL


def test_the_largest_tilt_is_the_angle_of_the_trunk_to_the_vertical(monkeypatch):
    monkeypatch.setattr(cases, "walked", lambda run, config: {"errors": None})
    qpos = np.zeros((3, 19))
    qpos[:, 3] = 1.0
    half = np.radians(20.0) / 2
    qpos[1, 3:7] = np.cos(half), np.sin(half) * 0.6, np.sin(half) * 0.8, 0.0
    found = cases.observed(SimpleNamespace(qpos=qpos, fell=False), None)
    assert found["largest_tilt_deg"] == pytest.approx(20.0)
    assert cases.observed(SimpleNamespace(qpos=qpos, fell=True), None)["largest_tilt_deg"] is None


def test_a_seed_in_which_one_walk_fell_has_no_errors():
    rows = [row(cases.walk_config("momentum", one, 1.0)) for one in cases.STEADY] * 2
    rows[1] = {"fell": True, "errors": None, "cost": cases.FALL}
    found = study.summary(rows, len(cases.STEADY))
    assert found["falls"]["count"] == 1
    assert found["v_y_rmse_mps"] == 0.02
    none = study.summary([rows[1]], 1)
    assert none["cost"] is None
    assert report._cost(none) == "1 of 1 fell"


def test_the_title_names_a_model_only_where_its_interval_is_its_own():
    def entry(median, low, high):
        return {"tuned": {"steady": {"cost": median, "cost_interval": (low, high)}}}

    record = {"cases": ["steady"], "models": {"momentum": entry(1, 0.9, 1.1),
                                              "convex": entry(3, 2.0, 4.0)}}  # fmt: skip
    assert report.title(record) == "Tuned alike, momentum costs least: steady commands"
    record["models"]["present"] = entry(1.05, 1.0, 1.2)
    assert report.title(record) == "No model is clearly best: steady commands"
