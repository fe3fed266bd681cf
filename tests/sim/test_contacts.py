import numpy as np
import pytest

from kjax.config import RunConfig, SimConfig
from kjax.robots import go1
from kjax.sim.contacts import body_contact
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import build_scene, start_state


@pytest.mark.parametrize(("base", "height"), [("planar", 1), ("free", 2)])
def test_a_standing_robot_touches_with_its_feet_only_and_a_lowered_one_with_its_body(base, height):
    config = RunConfig(sim=SimConfig(base=base))
    model = build_scene(config, visual=False)
    qpos, _ = start_state(config, model)
    rows = np.repeat(qpos[None], 3, axis=0)
    rows[1, height] = 0.04  # below the trunk's half-height
    rows[2, height] = 1.0
    np.testing.assert_array_equal(
        body_contact(model, find_addresses(go1.ROBOT, model), rows), [False, True, False]
    )
