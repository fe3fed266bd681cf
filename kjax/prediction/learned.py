"""Learned lifting: a small network beside the state, trained on many-step prediction (optax).

    z = [1, x, MLP((x - centre) / scale)],   z+ = A z + sum_i z_i B_i u

with B_i = 0 but for the constant in a linear head. The first A and B are the least-squares fit for
the network's random start (``edmd.fit_bilinear`` with random features, that is), so that training
begins where EDMD ends. The network does not see p_x, which nothing depends on.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from kjax.koopman import regression
from kjax.koopman.dataset import Snapshots
from kjax.koopman.models import BilinearModel
from kjax.koopman.observables import STATE_ROWS
from kjax.prediction.families import Family, Start
from kjax.types import STATE_DIM, STATE_NAMES

Head = Literal["linear", "bilinear"]


class Layer(NamedTuple):
    """One layer of the network: W a + b."""

    W: Float[Array, "out in"]
    b: Float[Array, "out"]


class LearnedModel(NamedTuple):
    """Parameters of a learned model.

    Attributes:
      layers: of the network; tanh between them, none after the last.
      head: transition and input maps.
      centre: (6,) middle of the training data.
      scale: (6,) its standard deviation.
    """

    layers: tuple[Layer, ...]
    head: BilinearModel
    centre: Float[Array, "6"]
    scale: Float[Array, "6"]


class Training(NamedTuple):
    """How a training went.

    Attributes:
      loss: (updates,) training loss: mean square of the many-step error of all states, in units of
        how far each of them moves [-].
      held_out: (updates // every,) the same on held-out rollouts, ``extra_loss`` included.
      diverged: whether the loss left the finite parameters; the model is the best one before.
    """

    loss: Float[Array, "updates"]
    held_out: Float[Array, "checks"]
    diverged: Array


def learned(dt: float, features: int) -> Family:
    """``learned``: parameters are a ``LearnedModel`` with so many learned observables."""
    names = ("1", *STATE_NAMES, *(f"learned {i}" for i in range(features)))

    def step(params: LearnedModel, start: Start, z: Array, u: Array) -> Array:
        return params.head.step(z, u, start.feet)

    return Family("learned", dt, names, lambda params, start: lift(params, start.x), step)


def lift(params: LearnedModel, x: Float[Array, "6"]) -> Float[Array, "N"]:
    """Lifted state [1, x, MLP(x)]."""
    a = ((x - params.centre) / params.scale)[1:]
    *inner, last = params.layers
    for layer in inner:
        a = jnp.tanh(layer.W @ a + layer.b)
    a = last.W @ a + last.b
    return jnp.concatenate([jnp.ones((1,), x.dtype), x, a])


def initial(
    key: PRNGKeyArray, data: Snapshots, *, hidden: int = 32, features: int = 8, head: Head
) -> LearnedModel:
    """Random network, least-squares head.

    Args:
      key: random key.
      data: training rollouts of one mode.
      hidden: width of the two inner layers.
      features: number of learned observables.
      head: ``"linear"`` or ``"bilinear"``.
    """
    if head not in ("linear", "bilinear"):
        raise ValueError(f"head must be 'linear' or 'bilinear', got {head!r}")
    flat = data.states.reshape(-1, STATE_DIM)
    centre, scale = flat.mean(axis=0), flat.std(axis=0) + 1e-6
    sizes = (STATE_DIM - 1, hidden, hidden, features)
    keys = jax.random.split(key, len(sizes) - 1)
    dtype = flat.dtype
    layers = tuple(
        Layer(
            W=jax.random.normal(k, (o, i), dtype) / jnp.sqrt(jnp.asarray(i, dtype)),
            b=jnp.zeros((o,), dtype),
        )
        for k, i, o in zip(keys, sizes[:-1], sizes[1:], strict=True)
    )
    N = 1 + STATE_DIM + features
    empty = BilinearModel(*(jnp.zeros(s, dtype) for s in ((N, N), (N, N, 4), (4, N, 4))))
    params = LearnedModel(layers, empty, centre, scale)
    return params._replace(head=_least_squares(params, data, head))


def _least_squares(params: LearnedModel, data: Snapshots, head: Head) -> BilinearModel:
    """The head that fits one step best, network as it is; a small ridge keeps it tame."""
    lifted = jax.vmap(jax.vmap(lambda x: lift(params, x)))(data.states)
    now, then = lifted[:, :-1], lifted[:, 1:]
    N = now.shape[-1]
    if head == "bilinear":
        inputs = (now[..., :, None] * data.inputs[..., None, :]).reshape(*now.shape[:2], -1)
    else:
        inputs = data.inputs
    Z = jnp.concatenate([now, inputs], axis=-1).reshape(-1, N + inputs.shape[-1])
    weights = regression.solve(
        regression.of_rows(Z, (then - now).reshape(-1, N)), Z.shape[1], ridge=1e-9
    )
    K = weights.W.T
    B = jnp.zeros((N, N, 4), K.dtype)
    B = (
        jnp.moveaxis(K[:, N:].reshape(N, N, 4), 1, 0)
        if head == "bilinear"
        else B.at[0].set(K[:, N:])
    )
    none = jnp.zeros((4, N, 4), K.dtype)
    return BilinearModel(A=jnp.eye(N, dtype=K.dtype) + K[:, :N], B=B, B_feet=none)


def _units(params: LearnedModel, data: Snapshots) -> tuple[tuple[Layer, ...], BilinearModel]:
    """What a change of 1 means for each trained number: that of the network's is its own.

    An entry of the head is measured by the change of its observable in a step over the size of
    what it multiplies: one rate then suits a velocity's response to a newton and a slow decay.
    """
    lifted = jax.vmap(jax.vmap(lambda x: lift(params, x)))(data.states)
    change = jnp.diff(lifted, axis=1).std(axis=(0, 1))
    size = jnp.sqrt((lifted**2).mean(axis=(0, 1)))
    force = data.inputs.std(axis=(0, 1))
    A = change[:, None] / (size + 1e-9)[None]
    B = A[:, :, None].swapaxes(0, 1) / (force + 1e-9)[None, None]
    layers = jax.tree.map(jnp.ones_like, params.layers)
    return layers, BilinearModel(A, B, jnp.zeros_like(params.head.B_feet))


def prediction_loss(
    params: LearnedModel, data: Snapshots, unit: Float[Array, "6"]
) -> Float[Array, ""]:
    """Mean square over rollouts, steps and states of the many-step error in ``unit``."""

    def one(states: Array, inputs: Array, feet: Array) -> Array:
        def step(z: Array, u: Array) -> tuple[Array, Array]:
            z = params.head.step(z, u, feet)
            return z, z[STATE_ROWS]

        _, predicted = jax.lax.scan(step, lift(params, states[0]), inputs)
        return jnp.mean(((predicted - states[1:]) / unit[None]) ** 2)

    return jax.vmap(one)(*data).mean()


def train(
    key: PRNGKeyArray,
    data: Snapshots,
    *,
    head: Head = "bilinear",
    hidden: int = 32,
    features: int = 8,
    window: int = 20,
    updates: int = 1000,
    batch: int = 64,
    rate: float = 1e-2,
    every: int = 50,
    extra_loss: Callable[[LearnedModel], Float[Array, ""]] | None = None,
) -> tuple[LearnedModel, Training]:
    """Train on windows of rollouts; ``vmap`` it over modes and seeds.

    Eleven arguments: the data, and hyperparameters by keyword.

    Args:
      key: random key.
      data: rollouts of one mode; a fifth of them is held out, the best model on it is returned.
      head: ``"linear"`` or ``"bilinear"``.
      hidden: width of the two inner layers.
      features: number of learned observables.
      window: steps of a prediction in the loss.
      updates: of Adam.
      batch: windows per update.
      rate: of Adam at first, in what each number moves by itself (see ``_units``); it falls to a
        hundredth along a cosine.
      every: updates between two looks at the held-out rollouts.
      extra_loss: further term of the loss and of the choice of the best model, such as a closed
        loop's cost.

    Returns:
      The model and how it went. Loss and held-out loss are in units of each state's spread of
      changes over a window. What is not finite stops nothing; ``diverged`` says so.
    """
    rollouts, steps = data.inputs.shape[:2]
    if window > steps:
        raise ValueError(f"window must be at most the rollouts' {steps} steps, got {window}")
    held = max(1, rollouts // 5)
    if rollouts - held < 1:
        raise ValueError(f"data must hold at least 2 rollouts, got {rollouts}")
    test, fit = (jax.tree.map(lambda a, s=s: a[s], data) for s in (slice(held), slice(held, None)))
    key_init, key_loop = jax.random.split(key)
    params = initial(key_init, fit, hidden=hidden, features=features, head=head)
    change = data.states[:, window:] - data.states[:, :-window]
    unit = change.std(axis=(0, 1)) + 1e-9
    short = test._replace(states=test.states[:, : window + 1], inputs=test.inputs[:, :window])

    def value_of(model: LearnedModel, windows: Snapshots) -> Array:
        value = prediction_loss(model, windows, unit)
        return value if extra_loss is None else value + extra_loss(model)

    def loss(parts: Any, key: Array) -> Array:
        layers, maps = parts
        if head == "linear":
            maps = maps._replace(B=jnp.zeros_like(maps.B).at[0].set(maps.B[0]))
        maps = maps._replace(B_feet=jnp.zeros_like(maps.B_feet))
        model = params._replace(layers=layers, head=maps)
        return value_of(model, _draw_windows(key, fit, window, batch))

    begin, update = _build_update(loss, _units(params, fit), rate, updates)

    def stretch(carry: Any, keys: Array) -> tuple[Any, tuple[Array, Array]]:
        inner, best, best_value = carry
        inner, values = jax.lax.scan(update, inner, keys)
        now = params._replace(layers=inner[0][0], head=inner[0][1])
        value = value_of(now, short)
        better = value < best_value  # NaN is never better
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), inner[0], best)
        return (inner, best, jnp.where(better, value, best_value)), (values, value)

    checks = max(1, updates // every)
    keys = jax.random.split(key_loop, (checks, min(every, updates)))
    first = value_of(params, short)
    parts = (params.layers, params.head)  # what is trained
    (_, best, _), (losses, held_out) = jax.lax.scan(
        stretch, ((parts, begin(parts)), parts, first), keys
    )
    model = params._replace(layers=best[0], head=best[1])
    losses = losses.reshape(-1)
    return model, Training(losses, held_out, ~jnp.isfinite(losses).all())


def _draw_windows(key: Array, data: Snapshots, window: int, batch: int) -> Snapshots:
    """Windows of random rollouts that begin at random steps."""
    rollouts, steps = data.inputs.shape[:2]
    row, place = jax.random.split(key)
    which = jax.random.randint(row, (batch,), 0, rollouts)
    begin = jax.random.randint(place, (batch,), 0, steps - window + 1)

    def one(i: Array, first: Array) -> Snapshots:
        return Snapshots(
            states=jax.lax.dynamic_slice_in_dim(data.states[i], first, window + 1),
            inputs=jax.lax.dynamic_slice_in_dim(data.inputs[i], first, window),
            feet=data.feet[i],
        )

    return jax.vmap(one)(which, begin)


def _build_update(
    loss: Callable[[Any, Array], Array], units: Any, rate: float, updates: int
) -> tuple[Callable[[Any], Any], Callable[[Any, Array], tuple[Any, Array]]]:
    """State of Adam at parameters; and an update of both by a key, in units of each parameter."""
    import optax

    schedule = optax.cosine_decay_schedule(rate, updates, alpha=0.01)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))

    def scaled(parts: Any) -> Any:
        return jax.tree.map(jnp.multiply, parts, units)

    def update(carry: Any, key: Array) -> tuple[Any, Array]:
        parts, state = carry
        value, slope = jax.value_and_grad(loss)(parts, key)
        change, state = optimiser.update(scaled(slope), state)
        return (optax.apply_updates(parts, scaled(change)), state), value

    return optimiser.init, update
