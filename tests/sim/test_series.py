"""What is kept of an episode for the figures: one sample per control tick, whole files only."""

import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.sim import series


@pytest.mark.parametrize("dt", [0.001, 0.005])  # a single run, and one from a batch
def test_a_series_has_a_sample_every_five_milliseconds(standing_run, tmp_path, dt):
    config = load_config(RunConfig, None, {"sim.sim_dt": dt, "leg.act_dt": dt, "duration": 1.0})
    run = standing_run(config, 1.0)
    series.save_series(run, tmp_path / "run.npz")
    kept = series.load_series(tmp_path / "run.npz")
    np.testing.assert_allclose(kept.time, np.arange(200) * 0.005, atol=1e-6)
    assert kept.x.dtype == np.float32
    assert kept.stance.dtype == bool


def test_a_series_that_cannot_be_written_leaves_none(standing_run, tmp_path, monkeypatch):
    run = standing_run(load_config(RunConfig, None, {"duration": 1.0}), 1.0)

    def full(path, **arrays):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space"):
        series.save_series(run, tmp_path / "run.npz")
    assert not (tmp_path / "run.npz").exists()
