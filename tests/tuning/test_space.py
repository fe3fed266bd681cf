import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.controllers.resolve import resolve
from kjax.robots import go1
from kjax.tuning.space import TUNABLE, build_space, tuned_config

BOUND = load_config(RunConfig, None, {"gait.names": ["bound"]})
SOME = ("lmpc.Q", "lmpc.grf_z_min", "leg.foothold_gain", "gaits.bound.foothold_front",
        "gaits.bound.force_edge", "gaits.bound.R", "multiphase.height_time")  # fmt: skip


def test_the_variables_of_a_config_give_its_own_parameters():
    space = build_space(BOUND, SOME)
    ours, theirs = space.params(space.start), resolve(BOUND, go1.PARAMS)[1]
    # exp(log(p)) is p to rounding, and the condensed Hessians have condition numbers up to 1e6.
    for own, wanted in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        own, wanted = (np.asarray(leaf, float) for leaf in (own, wanted))
        limit = np.abs(wanted[np.isfinite(wanted)]).max(initial=0.0)
        np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-8 * limit)


def test_every_kind_of_number_exists_in_the_config_and_comes_back():
    free = [key for key in TUNABLE if not key.startswith("srb.") and value(BOUND, key) is not None]
    assert sum(key.startswith("gaits.bound.") for key in free) == 15
    space = build_space(BOUND, free)
    tuned = tuned_config(BOUND, space.overrides(space.start))
    for key in free:
        np.testing.assert_allclose(value(tuned, key), value(BOUND, key), rtol=1e-12)


def value(config, key):
    for part in key.split("."):
        config = getattr(config, part)
    return config


def test_a_gait_of_ones_own_may_be_tuned():
    config = load_config(RunConfig, None, {"gaits.own.body_height": 0.61, "gait.names": ["own"]})
    space = build_space(config, ["gaits.own.body_height"])
    params = space.params({"gaits.own.body_height": jnp.log(0.6)})
    np.testing.assert_allclose(
        params.height, 0.426 * np.array([0.6338, 0.6338, 0.6338, 0.6]), rtol=1e-6
    )
    assert space.kinds == {"gaits.own.body_height": TUNABLE["gaits.trot.body_height"]}
    with pytest.raises(ValueError, match=r"gaits\.own\.swing_height' is no variable"):
        build_space(config, ["gaits.own.swing_height"])
    with pytest.raises(ValueError, match=r"gaits\.own\.Q is not given by the config"):
        build_space(config, ["gaits.own.Q"])


def test_a_tuned_config_holds_the_new_values_and_no_others():
    new = tuned_config(BOUND, {"gaits.bound.force_edge": 0.4, "lmpc.Q": [1.0] * 6})
    assert new.gaits.bound.force_edge == 0.4
    assert new.lmpc.Q == (1.0,) * 6
    assert new.gaits.bound == dataclasses.replace(BOUND.gaits.bound, force_edge=0.4)
    assert new.command == BOUND.command


def test_a_step_of_a_tenth_is_ten_per_cent_of_a_weight():
    space = build_space(BOUND, ["gaits.bound.Q"])
    shifted = {key: one + 0.1 for key, one in space.start.items()}
    own = BOUND.gaits.bound.Q
    ratio = np.array(space.overrides(shifted)["gaits.bound.Q"]) / own
    np.testing.assert_allclose(ratio, np.exp(0.1), rtol=1e-12)


def test_variables_are_brought_back_into_what_a_config_may_hold():
    space = build_space(BOUND, ["gaits.bound.force_edge", "gaits.bound.foothold_gain"])
    far = {key: one + 100.0 for key, one in space.start.items()}
    inside = space.overrides(space.inside(far))
    assert inside["gaits.bound.force_edge"] == pytest.approx(TUNABLE["gaits.bound.force_edge"].high)
    assert inside["gaits.bound.foothold_gain"] == pytest.approx(
        TUNABLE["gaits.bound.foothold_gain"].high
    )
    tuned_config(BOUND, inside)  # is valid


def test_the_mass_of_a_rigid_body_model_is_a_variable_of_its_prediction():
    config = load_config(RunConfig, None, {"koopman.model": "planted", "koopman.feet": "measured"})
    space = build_space(config, ["srb.mass", "srb.inertia"])
    heavier = {**space.start, "srb.mass": space.start["srb.mass"] + jnp.log(2.0)}
    body = space.params(heavier).fits.prediction.params.body
    np.testing.assert_allclose(body.mass, 2.0 * go1.PARAMS.mass, rtol=1e-12)
    np.testing.assert_allclose(body.inertia, go1.PARAMS.pitch_inertia, rtol=1e-12)


@pytest.mark.parametrize(
    ("keys", "overrides", "text"),
    [
        (["lmpc.state_weight"], {}, "'lmpc.state_weight' is no variable"),
        (["lmpc.control_dt"], {}, "'lmpc.control_dt' is no variable"),
        (["srb.mass"], {}, "fitted to data"),
        (["lmpc.Q"], {"koopman.model": "linar"}, r"koopman\.model: got 'linar'"),
        ([], {}, "at least one"),
        (
            ["lmpc.Q"],
            {"lmpc.Q": [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]},
            "lmpc.Q must be positive",
        ),
    ],
)
def test_what_cannot_be_tuned_is_refused_by_name(keys, overrides, text):
    config = load_config(RunConfig, None, overrides)
    with pytest.raises(ValueError, match=text):
        build_space(config, keys)


def test_in_three_dimensions_the_variables_give_the_config_s_own_parameters_and_fit_nothing():
    config = load_config(RunConfig, None, {"controller": "spatial"})
    keys = [key for key in TUNABLE if key.startswith("spatial.")]
    space = build_space(config, [*keys, "lateral.foothold_gain", "srb.mass"])
    ours, theirs = space.params(space.start), resolve(config, go1.PARAMS)[1]
    assert ours.fits is None
    pairs = zip(jax.tree.leaves(ours.spatial), jax.tree.leaves(theirs.spatial), strict=True)
    for own, wanted in pairs:
        np.testing.assert_allclose(own, wanted, rtol=1e-12)
    np.testing.assert_allclose(ours.lateral.foothold_gain, theirs.lateral.foothold_gain, rtol=1e-12)
