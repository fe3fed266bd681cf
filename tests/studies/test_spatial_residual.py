"""The residual in three dimensions: records are what MuJoCo says, and what is told of them."""

import json

import jax
import mujoco
import numpy as np
import pytest

from kjax.config import ConfigError, RunConfig, load_config
from kjax.config.shipped import shipped_config
from kjax.controllers.resolve import resolve
from kjax.dynamics.srb_spatial import BodyState
from kjax.files import file_hashes
from kjax.prediction import residual_wrench
from kjax.prediction.residual_wrench import SHAPE, ResidualWrench
from kjax.robots import get_robot
from kjax.sim.resolve import batch_spec
from kjax.sim.scene import build_model
from kjax.studies.spatial_residual import recordings, report, study
from kjax.sysid.spatial_residual import SpatialEpisode, phase_over

TICKS = 4


@pytest.fixture(scope="module")
def drawn():
    """Two robots near standing, at random attitudes and speeds, and what C MuJoCo says of them."""
    config = recordings.recorded_configs(1, 3.0)[0]
    model = build_model(get_robot("go1"), batch_spec(config).scene)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    qpos, qvel = np.empty((TICKS, 2, model.nq)), rng.normal(0.0, 0.3, (TICKS, 2, model.nv))
    com, com_vel = np.empty((TICKS, 2, 3)), np.empty((TICKS, 2, 3))
    for k in range(TICKS):
        for robot in range(2):
            mujoco.mj_resetDataKeyframe(model, data, 0) if model.nkey else None
            quat = rng.normal([1.0, 0.0, 0.0, 0.0], 0.1)
            q = np.concatenate([[0.3, 0.1, 0.3], quat / np.linalg.norm(quat), np.zeros(12)])
            q[7:] = np.tile([0.05, 0.8, -1.6], 4) + rng.normal(0.0, 0.1, 12)
            data.qpos[:], data.qvel[:] = q, qvel[k, robot]
            mujoco.mj_forward(model, data)
            mujoco.mj_subtreeVel(model, data)
            qpos[k, robot] = q
            com[k, robot], com_vel[k, robot] = data.subtree_com[1], data.subtree_linvel[1]
    arrays = {
        "qpos": qpos, "qvel": qvel, "force": np.ones((TICKS, 2, 4, 3)),
        "stance": np.ones((TICKS, 2, 4), bool), "foot_force": np.full((TICKS, 2, 4), 20.0),
        "fell": np.array([False, True]),
    }  # fmt: skip
    return config, arrays, com, com_vel


def test_recorded_states_are_those_of_mujoco(drawn):
    config, arrays, com, com_vel = drawn
    episodes = jax.tree.map(np.asarray, recordings._episodes(arrays, config))
    # The robot that fell is left out; time comes after the robots.
    assert episodes.states.p.shape == (1, TICKS, 3)
    np.testing.assert_allclose(episodes.states.p[0], com[:, 0], atol=1e-6)
    np.testing.assert_allclose(episodes.states.v[0], com_vel[:, 0], atol=1e-6)
    for k in range(TICKS):
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, arrays["qpos"][k, 0, 3:7])
        np.testing.assert_allclose(episodes.states.R[0, k], R.reshape(3, 3), atol=1e-6)
        omega = R.reshape(3, 3) @ arrays["qvel"][k, 0, 3:6]
        np.testing.assert_allclose(episodes.omega[0, k], omega, atol=1e-6)
    assert episodes.touch.all()


def test_forces_are_perturbed_and_robots_differ():
    configs = recordings.recorded_configs(3, 5.0)
    assert all(one.noise.force == recordings.FORCE for one in configs)
    assert len({one.command.v_x for one in configs}) == 3
    assert {one.duration for one in configs} == {5.0}


def residual_config(file, model="residual"):
    keys = {"spatial.model": model, "spatial.file": str(file)}
    return load_config(RunConfig, shipped_config("omni_trot"), keys)


def test_a_config_takes_the_file_that_it_names(tmp_path):
    W = np.random.default_rng(0).normal(size=SHAPE)
    path = residual_wrench.save(tmp_path / "own.npz", ResidualWrench(W))
    config = residual_config(path)
    params = resolve(config)[1]
    np.testing.assert_array_equal(params.spatial.learned.W, W)
    before = file_hashes(config)["spatial.file"]
    residual_wrench.save(path, ResidualWrench(2.0 * W))
    assert file_hashes(config)["spatial.file"] != before
    np.testing.assert_array_equal(resolve(config)[1].spatial.learned.W, 2.0 * W)


def test_a_residual_without_a_file_and_a_file_without_a_residual_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="file must name a fitted residual"):
        residual_config("")
    with pytest.raises(ConfigError, match="model = 'momentum' takes no file"):
        residual_config(tmp_path / "own.npz", "momentum")
    with pytest.raises(ConfigError, match=r"spatial\.file: cannot read .*none\.npz"):
        resolve(residual_config(tmp_path / "none.npz"))


def entry(value):
    return {"median": value, "interval": [0.9 * value, 1.1 * value], "unit": "deg"}


def record_of():
    def rows(scale):
        return [
            {"time_s": t, **{name: entry(scale * t) for name in report.QUANTITIES}}
            for t in (0.025, 0.05, 0.1, 0.2)
        ]

    walk = {
        "command": [1.0, 0.0, 0.0], "episodes": 8, "falls": 1, "v_x_rmse_mps": 0.0123,
        "v_y_rmse_mps": 0.02, "yaw_rate_cycle_rmse_radps": 0.004, "roll_p95_deg": 0.5,
        "pitch_p95_deg": None,
    }  # fmt: skip
    return {
        "quick": False,
        "prediction": {"body": rows(30.0), "residual": rows(10.0)},
        "walks": {"body": [walk], "residual": [walk]},
    }


def test_table_and_figure_tell_both_models(tmp_path):
    text = report.table(record_of())
    assert "| attitude [deg] | rigid body | 0.75" in text
    assert "| attitude [deg] | with the residual | 0.25" in text
    assert "| 1, 0, 0 | with the residual | 1 of 8 | 0.0123 |" in text
    report.figure(record_of(), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def still_episodes(count=12, ticks=120):
    """A robot on its diagonals in turn, pulled ahead by 0.5 m/s^2 and kept upright."""
    legs = np.array([[1, 0, 0, 1] if k % 40 < 20 else [0, 1, 1, 0] for k in range(ticks)], bool)
    force = legs[..., None] * np.array([0.0, 0.0, 12.74 * 9.81 / 2])
    feet = np.array([[0.2, -0.1, 0.0], [0.2, 0.1, 0.0], [-0.2, -0.1, 0.0], [-0.2, 0.1, 0.0]])
    t = 0.005 * np.arange(ticks)
    ahead = np.array([1.0, 0.0, 0.0])
    p = 0.25 * t[:, None] ** 2 * ahead + [0.0, 0.0, 0.27]
    rng, zero = np.random.default_rng(0), np.zeros((ticks, 3))
    one = SpatialEpisode(
        states=BodyState(p, np.tile(np.eye(3), (ticks, 1, 1)), 0.5 * t[:, None] * ahead, zero),
        omega=zero, feet=np.tile(feet, (ticks, 1, 1)), force=force, stance=legs, touch=legs,
        phase=phase_over(legs),
    )  # fmt: skip
    # Each pulled by a little more or less, so that intervals are some.
    return jax.tree.map(
        lambda a: np.stack([a if a.dtype == bool else a * (1 + 1e-4 * rng.normal())
                            for _ in range(count)]), one,
    )  # fmt: skip


def test_a_residual_is_chosen_and_reported_on_episodes_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "record", lambda *args: still_episodes())
    monkeypatch.setattr(study, "_walk", lambda args, folder, path: record_of()["walks"])
    assert study.main(["--quick", "--out", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "results.json").read_text())
    assert record["episodes"] == {
        "recorded": 12, "fitted": 6, "held_out": 4, "duration_s": 3.0,
    }  # fmt: skip
    body, residual = (record["prediction"][key][-1]["velocity"] for key in ("body", "residual"))
    assert body["median"] > 0.05
    assert residual["median"] < 0.5 * body["median"]
    assert residual_wrench.load(tmp_path / "residual.npz").W.any()
    assert "A quick check" in (tmp_path / "table.md").read_text()
