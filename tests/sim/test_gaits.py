"""Gaits that no code knows by name walk in C MuJoCo."""

import numpy as np
import pytest

from kjax.config import RunConfig, load_config
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.metrics import metrics
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_goal
from kjax.types import Leg

WALK = {"duration": 3.0, "command.times": [0.0, 0.5], "command.v_x": [0.0, 0.3]}
# A gait of one's own: a walk whose sides are exchanged.
MIRRORED = {"gaits.own.period": 0.8, "gaits.own.offset": [0.0, 0.5, 0.75, 0.25],
            "gaits.own.duty": [0.75] * 4}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gait", "roll", "pitch"),
    # Twice what each does; the planar LMPC sees nothing of roll.
    [("pace", 14.0, 2.0), ("pronk", 3.0, 8.0), ("walk", 18.0, 7.0), ("own", 18.0, 7.0),
     ("flying_trot", 20.0, 6.0)],
)  # fmt: skip
def test_a_gait_that_is_data_walks_on_the_free_base(gait, roll, pitch):
    config = load_config(RunConfig, None, WALK | MIRRORED | {"gait.names": [gait]})
    run = simulate(MujocoEngine(batch_spec(config)), resolve_episode(config))
    found = metrics(run, resolve_goal(config))
    assert not found["fell"]
    assert found["qp_unsolved"] == 0
    assert found["body_contact_fraction"] == 0.0
    assert found["roll_max_deg"] < roll
    assert found["pitch_max_deg"] < pitch
    # Over whole cycles, but for a flying trot, which keeps back of a step in the free base.
    period = config.gaits[gait].period
    cycles = int(1.5 / period) * period
    speed = run.x[run.time > 3.0 - cycles, 3].mean()
    assert speed == pytest.approx(0.3, abs=0.06 if gait == "flying_trot" else 0.03)
    # The legs stand when the gait says so.
    own = config.gaits[gait]
    place = (run.time / own.period) % 1.0
    late = (run.time > 3.0 - cycles) & (
        np.abs(run.time / 0.005 - np.round(run.time / 0.005)) < 1e-6
    )
    for leg in Leg:
        wanted = (place - own.offset[leg]) % 1.0 < own.duty[leg]
        if own.ramp_cycles == 0:
            assert (wanted == run.stance[:, leg])[late].mean() > 0.97
        share = run.stance[late, leg].mean()
        assert share == pytest.approx(own.duty[leg], abs=0.06)
