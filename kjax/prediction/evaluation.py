"""How well a model predicts: error of every state against the time since the start."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from kjax.dynamics import srb_planar
from kjax.koopman.dataset import SampleRanges, sample
from kjax.koopman.models import LinearModel, rollout
from kjax.koopman.observables import STATE_ROWS, Dictionary
from kjax.prediction import families
from kjax.types import GRAVITY


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
    body: srb_planar.SrbParams,
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

    Eleven arguments: the model, the body, and the size of the test set by keyword.

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
        truth = srb_planar.rollout(body, alpha, x0, u, dt)
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


def force_response_error(
    model: LinearModel,
    body: srb_planar.SrbParams,
    alpha: Int[np.ndarray, "2"],
    *,
    steps: int,
    duration: float,
) -> float:
    """Relative error of a linear model's velocity response to a held force, at the horizon's end.

    Powers of omega are observables that a linear fit closes badly. Where their coefficients are
    large the velocity follows from differences of large terms, which forces upset: prediction of
    a swinging body may still look right while an LMPC on the model throws the robot over.

    Args:
      model: of one contact mode, over one step.
      body: of that mode, with the contact points to judge at.
      alpha: (2,) stance legs at front and rear.
      steps: of the horizon.
      duration: of it [s].

    Returns:
      Largest error of d v / d u against the level, hovering rigid body (its tilt under gravity
      included), over the largest entry of the body's own response in that row [-].
    """
    held = jax.tree.map(lambda a: np.asarray(a, np.float64), model)
    B = held.B + np.tensordot(np.asarray(body.feet, np.float64).reshape(4), held.B_feet, axes=1)
    power, total = np.eye(len(B)), np.zeros_like(B)
    for _ in range(steps):
        total += power @ B
        power = held.A @ power
    mass, inertia = float(body.mass), float(body.inertia)
    wanted = np.zeros((2, 4))
    for end, legs in enumerate(np.asarray(alpha)):
        x, z = np.asarray(body.feet, np.float64)[end]
        wanted[0, 2 * end] = wanted[1, 2 * end + 1] = legs * duration / mass
        # A moment turns the body and with it the vertical force that carries the weight.
        pitch_acceleration = legs * np.array([-z, x]) / inertia
        wanted[0, 2 * end : 2 * end + 2] -= GRAVITY * pitch_acceleration * duration**3 / 6
    scale = np.abs(wanted).max(axis=1, keepdims=True)
    return float((np.abs(total[STATE_ROWS][3:5] - wanted) / scale).max())


# ---------------------------------------------------------------- any family, any plant

QUANTILES = (0.5, 0.9, 0.99)


def open_loop(
    family: families.Family,
    params: Any,
    start: families.Start,
    inputs: Float[Array, "steps 4"],
    *,
    frozen: bool = False,
) -> Float[Array, "steps_plus_1 6"]:
    """Prediction of a model; ``frozen`` as an LMPC uses it: linearised at the start.

    The force of that linearisation is the mean of the inputs.
    """
    if not frozen:
        return families.rollout(family, params, start, inputs)
    here = families.operating_point(family, params, start, inputs.mean(axis=0))
    return rollout(here, family.lift(params, start), inputs, start.feet)


def model_errors(
    family: families.Family,
    params: Any,
    plant: srb_planar.Plant,
    body: srb_planar.SrbParams,
    alpha: Float[Array, "2"],
    starts: Float[Array, "states 6"],
    inputs: Float[Array, "profiles steps 4"],
    *,
    frozen: bool = False,
) -> Float[Array, "states profiles steps 6"]:
    """Predicted minus true states of every start under every force profile, open loop.

    Eight arguments: a model (family, params), a body (plant, body, alpha), and what they meet.
    """

    def one(x0: Array, u: Array) -> Array:
        predicted = open_loop(family, params, families.Start(x0, body.feet), u, frozen=frozen)
        return (predicted - srb_planar.trajectory(plant, body, alpha, x0, u, family.dt))[1:]

    return jax.vmap(lambda x0: jax.vmap(lambda u: one(x0, u))(inputs))(starts)


def quantiles(
    errors: Float[Array, "states profiles steps 6"],
) -> Float[Array, "Q steps 6"]:
    """Quantiles (``QUANTILES``) of the absolute error, per step and state."""
    flat = jnp.abs(errors.reshape(-1, *errors.shape[-2:]))
    return jnp.quantile(flat, jnp.asarray(QUANTILES, flat.dtype), axis=0)


def bootstrap(
    key: PRNGKeyArray,
    errors: Float[Array, "episodes ..."],
    statistic: Callable[[Array], Array],
    *,
    draws: int = 400,
    level: float = 0.95,
) -> tuple[Array, Array]:
    """Percentile interval of a statistic, episodes drawn again with replacement.

    Rows of one episode are not independent of each other, so whole episodes are drawn.

    Args:
      key: random key.
      errors: (episodes, ...) what the statistic is of.
      statistic: from such an array to parameters.
      draws: resamples.
      level: of the interval.

    Returns:
      Lower and upper end, each shaped like the statistic.
    """
    if errors.shape[0] < 2:
        raise ValueError(f"errors must hold at least 2 episodes, got {errors.shape[0]}")
    index = jax.random.randint(key, (draws, errors.shape[0]), 0, errors.shape[0])
    values = jax.lax.map(lambda i: statistic(errors[i]), index)
    side = 0.5 * (1.0 - level)
    low, high = jnp.quantile(values, jnp.asarray([side, 1.0 - side]), axis=0)
    return low, high
