"""Which configs a robot cannot walk with, and the rigid body that it walks with otherwise."""

import warnings

import numpy as np
import pytest

from kjax import build_params, load_config
from kjax.config import RunConfig
from kjax.rigid_body import mean_force
from kjax.robots import go1
from kjax.types import GRAVITY, MODE_ALPHA
from kjax.walkable import build_gaits, check_walkable

HEAVY = go1.PARAMS._replace(
    mass=np.asarray(83.0), trunk_mass=np.asarray(83.0 - float(4 * go1.PARAMS.link_mass.sum()))
)


def config(**keys):
    return load_config(RunConfig, None, {k.replace("__", "."): v for k, v in keys.items()})


def test_the_defaults_and_the_shipped_configs_are_not_complained_of(repository):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_walkable(RunConfig(), go1.PARAMS)
        for file in sorted((repository / "configs").glob("*.toml")):
            if file.stem != "koopman_fit":
                check_walkable(load_config(RunConfig, file), go1.PARAMS)


def test_bounds_that_cannot_carry_the_weight_name_their_key_and_what_is_needed():
    """2 x 160 N under 83 kg: half a second of trot takes 83 x 9.81 x 0.5 = 407 N s."""
    text = r"lmpc\.force_z_max: in a cycle of trot \(0\.5 s\) the feet can give 160 N s, and 488"
    with pytest.raises(ValueError, match=text):
        check_walkable(RunConfig(), HEAVY)
    with pytest.raises(ValueError, match=text):
        build_params(RunConfig(), HEAVY)
    check_walkable(config(lmpc__force_z_max=500.0), HEAVY)


@pytest.mark.parametrize(("horizon", "key"), [("stance", "bound"), ("multiphase", "multiphase")])
def test_a_bound_is_measured_by_the_bounds_that_its_horizon_uses(horizon, key):
    """0.35 s of 12.74 kg, 1.2 times: 52.5 N s out of 0.15 s of two feet: 175 N."""
    keys = {"gait.names": ["bound"], "bound.horizon": horizon, f"{key}.force_z_max": 174.0}
    with pytest.raises(ValueError, match=rf"{key}\.force_z_max: in a cycle of bound"):
        check_walkable(load_config(RunConfig, None, keys), go1.PARAMS)
    check_walkable(load_config(RunConfig, None, keys | {f"{key}.force_z_max": 176.0}), go1.PARAMS)


@pytest.mark.parametrize(("gait", "key"), [("trot", "lmpc"), ("bound", "bound")])
@pytest.mark.parametrize("height", [0.05, 0.50])
def test_a_height_that_the_legs_do_not_reach_is_refused(gait, key, height):
    keys = {"gait.names": [gait], f"{key}.height": height}
    with pytest.raises(ValueError, match=rf"{key}\.height is {height} m; the legs reach"):
        check_walkable(load_config(RunConfig, None, keys), go1.PARAMS)


def test_another_mass_than_the_robots_is_warned_of_and_a_wrong_one_refused():
    with pytest.warns(UserWarning, match=r"srb\.mass is 10 kg, the robot's own 12\.74 kg"):
        check_walkable(config(srb__mass=10.0), go1.PARAMS)
    for mass in (6.0, 26.0):
        with pytest.raises(ValueError, match=rf"srb\.mass is {mass:g} kg, .* factor of 2"):
            check_walkable(config(srb__mass=mass), go1.PARAMS)


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"gait.trot_flight": 0.1},
        {"gait.names": ["bound"]},
        {"gait.names": ["bound"], "bound.feet_front": 0.10, "bound.front_stance": 0.08},
    ],
)
def test_the_mean_force_carries_the_weight_over_a_cycle_and_turns_nothing(keys):
    chosen = load_config(RunConfig, None, keys)
    (gait,) = [g for g in build_gaits(chosen) if g.name == chosen.gait.names[0]]
    force = np.asarray(mean_force(chosen, 12.0))
    impulses = np.array([p.duration * MODE_ALPHA[p.mode] * force[p.mode] for p in gait.phases])
    period = sum(p.duration for p in gait.phases)
    np.testing.assert_allclose(impulses.sum(), 12.0 * GRAVITY * period, rtol=1e-12)
    if gait.name == "bound":
        levers = np.array([chosen.bound.feet_front, -chosen.bound.feet_rear])
        # Rounding of impulses of 20 N s at 0.15 m.
        assert abs((impulses.sum(axis=0) * levers).sum()) < 1e-12


def test_the_papers_reference_is_no_force():
    force = mean_force(config(lmpc__input_reference="zero"), 12.0)
    np.testing.assert_array_equal(force, 0.0)
