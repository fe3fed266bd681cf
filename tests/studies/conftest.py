from types import SimpleNamespace

import numpy as np
import pytest

from kjax.runs.batches import batch_key
from kjax.studies import invariance, raw_steps


@pytest.fixture
def engine(monkeypatch):
    """Stand in for the engine: no physics, one row of metrics for every config; counts them."""
    count = []

    def run(cache, configs, *, torques, dtype=np.float64, measure=None, **more):
        for config in configs:
            key = batch_key(cache, config, torques, dtype, measure)
            if key not in cache:
                count.append(config)
                cache.add({key: row(config)})

    def row(config):
        out = {"fell": False, "velocity_rmse_mps": 0.02 + engine.error(config), "qp_unsolved": 0}
        return out | {
            "step_time_s": config.command.times[-1], "step_pitch_max_deg": engine.pitch(config),
            "step_pitch_at_s": 1.2, "body_contact_ticks": 0,
        }  # fmt: skip

    engine = SimpleNamespace(count=count, error=lambda config: 0.0, pitch=lambda config: 2.0)
    for module in (invariance, raw_steps):
        monkeypatch.setattr(module, "run_batch", run)
        monkeypatch.setattr(module.cli, "configure_jax", lambda **more: None)
    return engine
