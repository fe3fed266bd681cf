import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig, load_config
from kjax.resolve import resolve
from kjax.robots import go1
from kjax.tuning.space import TUNABLE, build_space, tuned_config

BOUND = load_config(RunConfig, None, {"gait.names": ["bound"]})
SOME = ("lmpc.state_weights", "lmpc.force_z_min", "leg.velocity_gain", "bound.feet_front",
        "bound.force_edge", "bound.input_weight", "multiphase.height_time")  # fmt: skip


def test_the_variables_of_a_config_give_its_own_parameters():
    space = build_space(BOUND, SOME)
    ours, theirs = space.params(space.start), resolve(BOUND, go1.PARAMS)[1]
    # exp(log(p)) is p to rounding, and the condensed Hessians have condition numbers up to 1e6.
    for own, wanted in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        own, wanted = (np.asarray(leaf, float) for leaf in (own, wanted))
        limit = np.abs(wanted[np.isfinite(wanted)]).max(initial=0.0)
        np.testing.assert_allclose(own, wanted, rtol=0, atol=1e-8 * limit)


def test_every_kind_of_number_exists_in_the_config_and_comes_back():
    free = [key for key in TUNABLE if not key.startswith("srb.")]
    space = build_space(BOUND, free)
    assert tuned_config(BOUND, space.overrides(space.start)) == pytest.approx(BOUND) or all(
        np.allclose(getattr(getattr(BOUND, section), name), value, rtol=1e-12)
        for (section, name), value in (
            (key.split("."), value) for key, value in space.overrides(space.start).items()
        )
    )


def test_a_tuned_config_holds_the_new_values_and_no_others():
    new = tuned_config(BOUND, {"bound.force_edge": 0.4, "lmpc.state_weights": [1.0] * 6})
    assert new.bound.force_edge == 0.4
    assert new.lmpc.state_weights == (1.0,) * 6
    assert new.bound == dataclasses.replace(BOUND.bound, force_edge=0.4)
    assert new.command == BOUND.command


def test_a_step_of_a_tenth_is_ten_per_cent_of_a_weight():
    space = build_space(BOUND, ["bound.state_weights"])
    moved = {key: one + 0.1 for key, one in space.start.items()}
    ratio = np.array(space.overrides(moved)["bound.state_weights"]) / BOUND.bound.state_weights
    np.testing.assert_allclose(ratio, np.exp(0.1), rtol=1e-12)


def test_variables_are_brought_back_into_what_a_config_may_hold():
    space = build_space(BOUND, ["bound.force_edge", "bound.velocity_gain"])
    far = {key: one + 100.0 for key, one in space.start.items()}
    inside = space.overrides(space.inside(far))
    assert inside["bound.force_edge"] == pytest.approx(TUNABLE["bound.force_edge"].high)
    assert inside["bound.velocity_gain"] == pytest.approx(TUNABLE["bound.velocity_gain"].high)
    tuned_config(BOUND, inside)  # is valid


def test_the_mass_of_a_rigid_body_model_is_a_variable_of_its_prediction():
    config = load_config(RunConfig, None, {"koopman.model": "planted", "koopman.feet": "measured"})
    space = build_space(config, ["srb.mass", "srb.inertia"])
    heavier = {**space.start, "srb.mass": space.start["srb.mass"] + jnp.log(2.0)}
    body = space.params(heavier).fits.prediction.numbers.body
    np.testing.assert_allclose(body.mass, 2.0 * go1.PARAMS.mass, rtol=1e-12)
    np.testing.assert_allclose(body.inertia, go1.PARAMS.pitch_inertia, rtol=1e-12)


@pytest.mark.parametrize(
    ("keys", "overrides", "text"),
    [
        (["lmpc.state_weight"], {}, "'lmpc.state_weight' is no variable"),
        (["lmpc.control_dt"], {}, "'lmpc.control_dt' is no variable"),
        (["srb.mass"], {}, "fitted to data"),
        ([], {}, "at least one"),
        (
            ["lmpc.state_weights"],
            {"lmpc.state_weights": [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]},
            "lmpc.state_weights must be positive",
        ),
    ],
)
def test_what_cannot_be_tuned_is_refused_by_name(keys, overrides, text):
    config = load_config(RunConfig, None, overrides)
    with pytest.raises(ValueError, match=text):
        build_space(config, keys)
