"""Which configs a robot cannot walk with, and the rigid body that it walks with otherwise."""

import warnings

import numpy as np
import pytest

from kjax import load_config
from kjax.config import ConfigError, RunConfig
from kjax.config.units import in_si
from kjax.controllers.resolve import resolve
from kjax.controllers.rigid_body import mean_force
from kjax.controllers.walkable import build_gaits, check_walkable
from kjax.robots import go1
from kjax.types import GRAVITY

HEAVY = go1.PARAMS._replace(
    mass=np.asarray(83.0),
    trunk_mass=np.asarray(83.0 - float(4 * go1.PARAMS.link_mass.sum())),
    torque_limit=7.0 * go1.PARAMS.torque_limit,
)
WEIGHT = float(go1.PARAMS.mass) * GRAVITY  # N


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
    text = r"lmpc\.grf_z_max: in a cycle of trot \(0\.5 s\) the feet can give 160 N s, and 488"
    weak = config(lmpc__grf_z_max=160.0 / (83.0 * GRAVITY))
    with pytest.raises(ValueError, match=text):
        check_walkable(weak, HEAVY)
    with pytest.raises(ValueError, match=text):
        resolve(weak, HEAVY)
    # The defaults are in weights of the robot.
    check_walkable(RunConfig(), HEAVY)


@pytest.mark.parametrize("name", ["bound", "bound_multiphase"])
def test_a_gait_is_measured_by_its_own_bounds(name):
    """0.35 s of 12.74 kg, 1.2 times: 52.5 N s out of 0.15 s of two feet: 175 N."""
    keys, key = {"gait.names": [name]}, f"gaits.{name}.grf_z_max"
    with pytest.raises(ValueError, match=rf"{key}: in a cycle of {name} \(0\.35 s\)"):
        check_walkable(load_config(RunConfig, None, keys | {key: 174.0 / WEIGHT}), go1.PARAMS)
    check_walkable(load_config(RunConfig, None, keys | {key: 176.0 / WEIGHT}), go1.PARAMS)


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("grf_z_max", 0.55, r"spatial\.grf_z_max: .*trot .*the feet can give"),
        ("torque_fraction", 0.2, r"spatial\.torque_fraction: .*trot .*the calf joints can press"),
    ],
)
def test_the_plan_in_three_dimensions_is_measured_by_its_own_bounds(key, value, text):
    own = {"controller": "spatial", "gait.also": [], "gait.names": ["trot"]}
    check_walkable(load_config(RunConfig, None, own), go1.PARAMS)
    # Bounds of the planar plans have no part in it.
    check_walkable(load_config(RunConfig, None, own | {f"lmpc.{key}": value}), go1.PARAMS)
    with pytest.raises(ValueError, match=text):
        check_walkable(load_config(RunConfig, None, own | {f"spatial.{key}": value}), go1.PARAMS)


@pytest.mark.parametrize(("gait", "key"), [("trot", "lmpc"), ("bound", "gaits.bound")])
@pytest.mark.parametrize("height", [0.05, 0.50])
def test_a_height_that_the_legs_do_not_reach_is_refused(gait, key, height):
    keys = {"gait.names": [gait], f"{key}.body_height": height / 0.426}
    with pytest.raises(
        ValueError, match=rf"{key}\.body_height is .* leg lengths, {height:g} m, but the legs"
    ):
        check_walkable(load_config(RunConfig, None, keys), go1.PARAMS)


def test_an_error_names_the_key_that_the_number_came_from():
    for keys, key in (
        ({"lmpc.grf_z_max": 0.48}, "lmpc.grf_z_max"),
        ({"gaits.trot.grf_z_max": 0.48}, "gaits.trot.grf_z_max"),
    ):
        with pytest.raises(ValueError, match=rf"^{key.replace('.', chr(92) + '.')}: in a cycle"):
            check_walkable(load_config(RunConfig, None, keys), go1.PARAMS)


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"gaits.trot.period": 0.008}, r"trot: .* a stance of FR, RL of 0\.004 s, .* 0\.005 s"),
        ({"gaits.bound.duty": [0.01, 0.01, 0.14, 0.14]}, r"bound: .* stance of FR, FL of 0\.0035"),
        (
            {"gaits.bound.ramp_start": 0.04},
            r"bound: .* flight times ramp_start of 0\.004 s, shorter than lmpc\.control_dt",
        ),
        ({"lmpc.control_dt": 0.06, "gaits.bound.ramp_cycles": 0},
         r"bound: .* stance of RR, RL of 0\.05 s, shorter"),
        ({"gait.names": ["flying_trot"], "gaits.flying_trot.duty": [0.495] * 4},
         r"flying_trot: .* flight of 0\.003 s"),
        ({"gaits.bound.transition_gait": "landing", "gaits.landing.period": 0.002},
         r"landing: .* of 0\.002 s"),
        (
            {"gait.names": ["bound_multiphase"], "gaits.bound_multiphase.duty": [0.6] * 4},
            r"bound_multiphase\.horizon = 'multiphase' takes one phase in which front legs",
        ),
        (
            {"gait.names": ["bound_multiphase"],
             "gaits.bound_multiphase.offset": [0.0, 0.05, 4 / 7, 4 / 7]},
            r"bound_multiphase\.horizon = 'multiphase' takes one phase in which front legs",
        ),
        ({"gaits.trot.reference": "periodic"}, r"trot\.reference = 'periodic' needs .* lift off"),
        ({"gaits.trot.switch_rule": "first_flight"}, r"trot\.switch_rule = .* has no flight"),
    ],
)  # fmt: skip
def test_a_timing_that_cannot_be_walked_names_its_gait(keys, text):
    with pytest.raises(ValueError, match=rf"gaits\.{text}"):
        check_walkable(load_config(RunConfig, None, keys), go1.PARAMS)


def test_phases_as_short_as_a_tick_are_allowed():
    """A flight need only reach the tick at its shortest, where its ramp begins."""
    keys = {"gaits.bound.period": 0.03, "gaits.bound.offset": [0.0, 0.0, 0.5, 0.5],
            "gaits.bound.duty": [1 / 6] * 4, "gaits.bound.ramp_start": 0.5}  # fmt: skip
    config = load_config(RunConfig, None, keys)
    check_walkable(config, go1.PARAMS)
    (bound,) = [one for one in build_gaits(config) if one.name == "bound"]
    np.testing.assert_allclose(bound.durations(0), 0.005, rtol=1e-9)


def test_another_mass_than_the_robots_is_warned_of_and_a_wrong_one_refused():
    with pytest.warns(UserWarning, match=r"srb\.mass is 10 kg, the robot's own 12\.74 kg"):
        check_walkable(config(srb__mass=10.0), go1.PARAMS)
    for mass in (6.0, 26.0):
        with pytest.raises(ValueError, match=rf"srb\.mass is {mass:g} kg, .* factor of 2"):
            check_walkable(config(srb__mass=mass), go1.PARAMS)


@pytest.mark.parametrize(
    ("key", "refused", "taken", "text"),
    [
        # Two feet of at least 80 N over all of a trot are more than 125 N of weight; 12.74 kg.
        (
            "gaits.trot.grf_z_min",
            80.0 / WEIGHT,
            50.0 / WEIGHT,
            r"trot \(0\.5 s\) the feet give at least 80 N s",
        ),
        # Over 0.35 s of a bound the weight is 43.7 N s, in 0.15 s of two feet: 146 N each.
        ("gaits.bound_multiphase.grf_z_min", 146.0 / WEIGHT, 100.0 / WEIGHT, "bound"),
        # A calf of 0.213 m under a hip at 0.27 m: 35.55 N m hold about 230 N on one leg.
        ("lmpc.torque_fraction", 0.3, 0.4, "trot"),
        ("multiphase.torque_fraction", 0.3, 0.9, "bound"),
    ],
)
def test_forces_that_cannot_balance_the_weight_name_their_key(key, refused, taken, text):
    """The least ones lift the robot; what the joints can press does not carry it."""
    own = {"gait.names": ["bound_multiphase"]} if "multi" in key else {}
    with pytest.raises(ValueError, match=rf"{key}: in a cycle of {text}"):
        check_walkable(load_config(RunConfig, None, own | {key: refused}), go1.PARAMS)
    check_walkable(load_config(RunConfig, None, own | {key: taken}), go1.PARAMS)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("lmpc.torque_fraction", 5.0),
        ("lmpc.torque_fraction", 1.01),
        ("lmpc.friction", 1e-6),
        ("multiphase.friction", 1e-6),
    ],
)
def test_limits_that_mean_nothing_are_refused(key, value):
    with pytest.raises(ConfigError, match=key.split(".")[1]):
        load_config(RunConfig, None, {key: value})


@pytest.mark.parametrize("inertia", [1e-9, 0.09, 1.7, 40.0])
def test_an_inertia_far_from_the_robots_is_refused(inertia):
    with pytest.raises(ValueError, match=rf"srb\.inertia is {inertia:g} kg m\^2, .* factor of 4"):
        check_walkable(config(srb__inertia=inertia), go1.PARAMS)
    check_walkable(config(srb__inertia=0.3), go1.PARAMS)


@pytest.mark.parametrize(
    ("key", "point", "text"),
    [
        ("feet_front", [0.2, 0.1], "above the centre of mass"),
        ("feet_front", [-0.01, -0.27], "not ahead of srb.feet_rear"),
        ("feet_rear", [-0.2, -1.5], "from the hip at"),
        ("feet_front", [2.0, -0.27], "from the hip at"),
    ],
)
def test_contact_points_that_no_foot_can_have_are_refused(key, point, text):
    keys = {"srb.feet_rear": [0.0, -0.27], f"srb.{key}": point}
    with pytest.raises(ValueError, match=rf"srb\.{key} is .*{text}"):
        check_walkable(load_config(RunConfig, None, keys), go1.PARAMS)
    check_walkable(config(srb__feet_front=[0.2, -0.25], srb__feet_rear=[-0.2, -0.25]), go1.PARAMS)


@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"gait.names": ["flying_trot"]},
        {"gait.names": ["bound"]},
        {"gait.names": ["bound"], "gaits.bound.foothold_front": 0.23, "gaits.bound.period": 0.4},
        {"gait.names": ["pronk"]},
        {"gait.names": ["walk"]},
        {"gait.names": ["pace"]},
    ],
)
def test_the_mean_force_carries_the_weight_over_a_cycle_and_turns_nothing(keys):
    chosen = load_config(RunConfig, None, keys)
    gaits = build_gaits(chosen)
    (index,) = [i for i, one in enumerate(gaits) if one.name == chosen.gait.names[0]]
    robot = go1.PARAMS
    force = np.asarray(mean_force(gaits, in_si(chosen, robot), robot))[index]
    legs = np.array([np.reshape(p.stance, (2, 2)).sum(axis=1) for p in gaits[index].phases])
    impulses = np.array([p.duration for p in gaits[index].phases])[:, None] * legs * force
    np.testing.assert_allclose(
        impulses.sum(), robot.mass * GRAVITY * gaits[index].period, rtol=1e-12
    )
    own = chosen.gaits[gaits[index].name]
    levers = np.array([own.foothold_front or 0.5, -(own.foothold_rear or 0.5)])
    # Rounding of impulses of 60 N s at 0.2 m.
    assert abs((impulses.sum(axis=0) * levers).sum()) < 1e-11


def test_the_papers_reference_is_no_force():
    chosen = config(lmpc__input_reference="zero")
    np.testing.assert_array_equal(
        mean_force(build_gaits(chosen), in_si(chosen, go1.PARAMS), go1.PARAMS), 0.0
    )
