"""How well a model predicts: error of every state against the time since the start."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from kjax import srb
from kjax.koopman.dataset import SampleRanges, sample
from kjax.koopman.models import LinearModel, rollout
from kjax.koopman.observables import Dictionary


class ErrorStatistics(NamedTuple):
    """Prediction error (predicted minus true) over a test set, per step and state.

    Attributes:
      mean: (steps, 6) [m, rad, m/s, rad/s].
      variance: (steps, 6), in the squares of those units.
      std: (steps, 6).
      max: (steps, 6) largest absolute error.
    """

    mean: Float[Array, "steps 6"]
    variance: Float[Array, "steps 6"]
    std: Float[Array, "steps 6"]
    max: Float[Array, "steps 6"]


def prediction_errors(
    key: PRNGKeyArray,
    model: LinearModel,
    dictionary: Dictionary,
    body: srb.SrbParams,
    alpha: Float[Array, "2"],
    ranges: SampleRanges,
    *,
    states: int,
    profiles: int,
    steps: int,
    dt: float,
    hold: int = 1,
) -> Float[Array, "states profiles steps 6"]:
    """Open-loop errors of every initial state under every force profile.

    The paper pairs 50 random initial states with 50 random force profiles over 0.05 s. The
    prediction lifts once, at the start, and then runs in the lifted space alone.

    Args:
      key: random key.
      model: of one contact mode.
      dictionary: that it was fitted in.
      body: true rigid body.
      alpha: (2,) stance legs at front and rear.
      ranges: of initial states and forces.
      states: number of initial states.
      profiles: number of force profiles.
      steps: steps of the rollout.
      dt: their length [s].
      hold: steps per random force.
    """
    draw = partial(sample, params=body, alpha=alpha, ranges=ranges, steps=steps, dt=dt, hold=hold)
    key_state, key_input = jax.random.split(key)
    starts = draw(key_state, rollouts=states).states[:, 0]
    inputs = draw(key_input, rollouts=profiles).inputs

    def one(x0: Array, u: Array) -> Array:
        truth = srb.rollout(body, alpha, x0, u, dt)
        predicted = rollout(model, dictionary.lift(x0), u, body.feet)
        return (predicted - truth)[1:]

    return jax.vmap(lambda x0: jax.vmap(lambda u: one(x0, u))(inputs))(starts)


def summarise(errors: Float[Array, "states profiles steps 6"]) -> ErrorStatistics:
    """Mean, variance, standard deviation and largest absolute error over the test set."""
    flat = errors.reshape(-1, *errors.shape[-2:])
    return ErrorStatistics(
        mean=flat.mean(axis=0),
        variance=flat.var(axis=0),
        std=flat.std(axis=0),
        max=jnp.abs(flat).max(axis=0),
    )
