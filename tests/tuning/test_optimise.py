import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax import RunConfig
from kjax.tuning import optimise
from kjax.tuning.space import build_space

SPACE = build_space(RunConfig(), ["lmpc.Q", "lmpc.R"])
TARGET = {key: one + 0.7 for key, one in SPACE.start.items()}
TRAIN, HELD_OUT = jnp.linspace(-0.1, 0.1, 4), jnp.linspace(-0.05, 0.05, 3)


def bowl(variables, scenario):
    """A bowl whose bottom each scenario moves a little."""
    parts = [jnp.sum((variables[key] - TARGET[key] - scenario) ** 2) for key in TARGET]
    return sum(parts) + 1.0


def descend(**options):
    return optimise.descend(bowl, SPACE, TRAIN, HELD_OUT, **{"updates": 60, "rate": 0.1, **options})


def test_the_descent_finds_the_bottom():
    result = descend(updates=250, patience=250)
    for key, one in result.best.items():
        np.testing.assert_allclose(one, TARGET[key], atol=0.02)
    assert result.stopped == "updates"
    assert result.healthy
    assert result.best_cost < result.held_out[0] / 3


def test_a_descent_that_was_cut_short_goes_on_to_the_same_numbers(tmp_path):
    whole = descend()
    path = tmp_path / "checkpoint.npz"

    class KillError(Exception):
        pass

    def kill(number, value, best):
        if number == 23:
            raise KillError

    with pytest.raises(KillError):
        descend(checkpoint=path, on_update=kill)
    resumed = descend(checkpoint=path)
    np.testing.assert_array_equal(resumed.cost, whole.cost)
    for key, one in whole.best.items():
        np.testing.assert_array_equal(resumed.best[key], one)
    # Finished: nothing is done again.
    calls = []
    again = descend(checkpoint=path, on_update=lambda *a: calls.append(a))
    assert not calls
    np.testing.assert_array_equal(again.cost, whole.cost)


def test_a_checkpoint_of_another_tuning_is_refused(tmp_path):
    path = tmp_path / "checkpoint.npz"
    descend(updates=5, checkpoint=path, identity="one")
    with pytest.raises(ValueError, match="of another tuning"):
        descend(updates=5, checkpoint=path, identity="two")
    path.write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="cannot read"):
        descend(updates=5, checkpoint=path, identity="one")


def test_what_is_not_finite_is_named_and_the_last_good_point_comes_back():
    def bad_cost(variables, scenario):
        value = bowl(variables, scenario)
        late = variables["lmpc.R"] > SPACE.start["lmpc.R"] + 0.6
        return jnp.where(late & (scenario > 0.09), jnp.nan, value)

    result = optimise.descend(bad_cost, SPACE, TRAIN, HELD_OUT, updates=60, rate=0.1)
    assert not result.healthy
    assert "the cost of scenario 3 is not finite (1 of 4)" in result.stopped
    assert np.isfinite(result.best_cost)
    assert result.best_cost < result.held_out[0]

    @jax.custom_jvp
    def root(x):
        return x

    root.defjvp(lambda p, t: (p[0], t[0] * jnp.where(p[0] > 0.0, jnp.nan, 1.0)))

    def bad_slope(variables, scenario):
        gone = variables["lmpc.R"] - SPACE.start["lmpc.R"] - 0.6
        return bowl(variables, scenario) + 1e-9 * root(gone)

    result = optimise.descend(bad_slope, SPACE, TRAIN, HELD_OUT, updates=60, rate=0.1)
    assert "the gradient of scenario 0 by lmpc.R is not finite" in result.stopped
    assert all(np.isfinite(one).all() for one in result.best.values())


def test_it_ends_when_the_held_out_scenarios_gain_no_more():
    def flat(variables, scenario):
        return bowl(variables, scenario) * jnp.where(jnp.abs(scenario) < 0.06, 0.0, 1.0)

    result = optimise.descend(flat, SPACE, TRAIN, HELD_OUT, updates=100, patience=10)
    assert result.stopped == "patience"
    assert result.best_update == 0
    assert len(result.cost) == 10


@pytest.mark.parametrize(("option", "value"), [("updates", 0), ("rate", -1.0), ("patience", 0)])
def test_unusable_numbers_are_refused(option, value):
    with pytest.raises(ValueError, match=option):
        descend(**{option: value})
