"""Gradient descent on a batch of scenarios, with held-out ones, early stopping and checkpoints.

    z <- z - Adam(mean over scenarios of dJ/dz),   J the cost of a closed loop, z as in ``space``

A scenario whose cost or gradient is not finite ends the descent at the last good point, and the
report names it and the parameter. After each look at the held-out scenarios everything is on disk,
so that the same call goes on after a kill, to the same result.
"""

import json
import time
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from kjax.config import RunConfig
from kjax.tuning.contract import CostWeights, Scenario
from kjax.tuning.loop import build_loop, cost, plant_of
from kjax.tuning.space import Space, Variables

Objective = Callable[[Variables, Scenario], Float[Array, ""]]


class Descent(NamedTuple):
    """How a descent went.

    Attributes:
      best: variables of the least cost on the held-out scenarios.
      best_cost: that cost.
      best_update: after which update.
      cost: (n,) mean cost on the training scenarios before each update.
      checks: (m,) updates before which the held-out scenarios were looked at.
      held_out: (m,) mean cost on them.
      seconds: spent, over all calls.
      stopped: why: "updates", "patience", "time", or what was not finite.
      healthy: whether everything was finite.
    """

    best: Variables
    best_cost: float
    best_update: int
    cost: np.ndarray
    checks: np.ndarray
    held_out: np.ndarray
    seconds: float
    stopped: str
    healthy: bool


def build_objective(
    config: RunConfig,
    space: Space,
    weights: CostWeights = CostWeights(),  # noqa: B008
    *,
    memory: float = inf,
) -> Objective:
    """Cost of one scenario as a function of the variables; ``vmap`` and differentiate it.

    Args:
      config: of the controller.
      space: of the variables.
      weights: of the cost.
      memory: of the derivatives, see ``loop.build_loop`` [s].
    """
    loop, plant = build_loop(config, memory=memory), plant_of(config)

    def objective(variables: Variables, scenario: Scenario) -> Array:
        params = space.params(variables)
        return cost(params.robot, loop(params, scenario), weights, plant)

    return objective


def descend(
    objective: Objective,
    space: Space,
    train: Scenario,
    held_out: Scenario,
    *,
    start: Variables | None = None,
    updates: int = 150,
    rate: float = 0.05,
    clip: float = 3.0,
    every: int = 5,
    patience: int = 30,
    seconds: float = inf,
    checkpoint: Path | None = None,
    identity: str = "",
    on_update: Callable[[int, float, float], None] | None = None,
) -> Descent:
    """Adam on the mean cost of ``train``; the best point on ``held_out`` is returned.

    Fourteen arguments: four that it is about, and an optimiser's options by keyword.

    Args:
      objective: of variables and a scenario.
      space: of the variables; each update is brought back into their ranges.
      train: scenarios (S, ...).
      held_out: scenarios that updates do not see (H, ...).
      start: variables; those of the config if ``None``.
      updates: of Adam, at most.
      rate: its learning rate, that falls to a tenth along a cosine.
      clip: longest gradient of a scenario, in medians over the scenarios.
      every: updates between two looks at the held-out scenarios.
      patience: updates without a better look before it ends.
      seconds: wall time before it stops, compilation and earlier calls included [s].
      checkpoint: file to keep the state in; an existing one is gone on from.
      identity: of everything that the result depends on; a checkpoint of another one is refused.
      on_update: called with the update, its cost and the best held-out cost.

    Raises:
      ValueError: for a checkpoint of another tuning, or unusable options.
    """
    for name, count in (("updates", updates), ("every", every), ("patience", patience)):
        if count < 1:
            raise ValueError(f"{name} must be at least 1, got {count}")
    if not rate > 0:
        raise ValueError(f"rate must be above 0, got {rate}")
    begin, slopes, move = _build_update(objective, space, train, updates, rate, clip)

    @jax.jit
    def look(variables: Variables) -> Array:
        return jax.vmap(objective, (None, 0))(variables, held_out).mean()

    variables = space.start if start is None else start
    limits = _Limits(updates, patience, seconds)
    run = _Run(variables, begin(variables), variables)
    if checkpoint is not None and checkpoint.exists():
        run = _load(checkpoint, identity, run)
        if run.stopped == "time":  # there may be more of it now
            run.stopped = _reason(run, run.checks[-1], limits)
    clock = time.perf_counter() - run.seconds
    while not run.stopped:
        number = len(run.cost)
        if number % every == 0 and (not run.checks or run.checks[-1] < number):
            run.judge(number, float(look(run.variables)))
            run.seconds = time.perf_counter() - clock
            run.stopped = _reason(run, number, limits)
            if checkpoint is not None:
                _save(checkpoint, identity, run)
            if run.stopped:
                break
        costs, slope = slopes(run.variables)
        fault = _fault(costs, slope)
        if fault:
            run.stopped = f"update {number}: {fault}"
            break
        run.variables, run.state = move(run.variables, run.state, slope)
        run.cost.append(float(costs.mean()))
        if on_update is not None:
            on_update(len(run.cost), run.cost[-1], run.best_cost)
    return run.descent()


def _build_update(
    objective: Objective,
    space: Space,
    train: Scenario,
    updates: int,
    rate: float,
    clip: float,
) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """State of Adam at variables; costs and slopes of all scenarios; variables and state after."""
    import optax

    optimiser = optax.adam(optax.cosine_decay_schedule(rate, updates, alpha=0.1))

    @jax.jit
    def slopes(variables: Variables) -> tuple[Array, Variables]:
        return jax.vmap(jax.value_and_grad(objective), (None, 0))(variables, train)

    @jax.jit
    def move(variables: Variables, state: Any, slope: Variables) -> tuple[Variables, Any]:
        # A scenario near a fall has a gradient far above the others': none counts for more than
        # some of them together.
        squares = [jnp.sum(a**2, axis=tuple(range(1, a.ndim))) for a in slope.values()]
        size = jnp.sqrt(jnp.sum(jnp.stack(squares), axis=0))
        limit = clip * jnp.median(size)
        part = jnp.minimum(1.0, limit / jnp.maximum(size, 1e-30))
        mean = jax.tree.map(lambda a: jnp.tensordot(part, a, axes=1) / len(part), slope)
        change, state = optimiser.update(mean, state, variables)
        return space.inside(optax.apply_updates(variables, change)), state

    return optimiser.init, slopes, move


class _Limits(NamedTuple):
    """When a descent stops: updates, updates without a better look, wall time [s]."""

    updates: int
    patience: int
    seconds: float


class _Run:
    """State of a descent, what a checkpoint holds."""

    def __init__(self, variables: Variables, state: Any, best: Variables):
        self.variables, self.state, self.best = variables, state, best
        self.best_cost: float = inf
        self.best_update = 0
        self.cost: list[float] = []
        self.checks: list[int] = []
        self.held_out: list[float] = []
        self.seconds, self.stopped = 0.0, ""

    @property
    def arrays(self) -> Any:
        return self.variables, self.state, self.best

    def judge(self, number: int, value: float) -> None:
        """Take down the held-out cost before an update; keep the variables if it is the least."""
        self.checks.append(number)
        self.held_out.append(value)
        if value < self.best_cost:
            self.best, self.best_cost, self.best_update = self.variables, value, number

    def descent(self) -> Descent:
        """How it went."""
        return Descent(
            best=self.best,
            best_cost=self.best_cost,
            best_update=self.best_update,
            cost=np.array(self.cost),
            checks=np.array(self.checks),
            held_out=np.array(self.held_out),
            seconds=self.seconds,
            stopped=self.stopped,
            healthy=self.stopped in ("updates", "patience", "time"),
        )


_PLAIN = ("best_cost", "best_update", "cost", "checks", "held_out", "seconds", "stopped")


def _reason(run: _Run, number: int, limits: _Limits) -> str:
    if not np.isfinite(run.held_out[-1]):
        return f"update {number}: the cost of the held-out scenarios is not finite"
    if number >= limits.updates:
        return "updates"
    if number - run.best_update >= limits.patience:
        return "patience"
    return "time" if run.seconds >= limits.seconds else ""


def _fault(costs: Array, slope: Variables) -> str:
    """Which scenario and which parameter is not finite, if any."""
    bad = np.flatnonzero(~np.isfinite(np.asarray(costs)))
    if len(bad):
        return f"the cost of scenario {bad[0]} is not finite ({len(bad)} of {len(costs)})"
    for key, one in slope.items():
        rows = np.asarray(one).reshape(len(costs), -1)
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            return f"the gradient of scenario {bad[0]} by {key} is not finite"
    return ""


def _save(path: Path, identity: str, run: _Run) -> None:
    """Write a checkpoint whole or not at all."""
    arrays = map(np.asarray, jax.tree.leaves(run.arrays))
    leaves: dict[str, Any] = {f"leaf_{i}": array for i, array in enumerate(arrays)}
    plain = {"identity": identity} | {name: getattr(run, name) for name in _PLAIN}
    scratch = path.with_name(path.name + ".part")
    with scratch.open("wb") as file:
        np.savez(file, plain=np.array(json.dumps(plain)), **leaves)
    scratch.replace(path)


def _read(path: Path, identity: str) -> tuple[dict[str, Any], dict[str, Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        plain = json.loads(str(arrays.pop("plain")))
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"checkpoint: cannot read '{path}': {error}") from None
    if plain["identity"] != identity:
        raise ValueError(
            f"checkpoint: '{path}' is of another tuning (other config, options or code); take "
            "another folder, or remove it"
        )
    return arrays, plain


def _load(path: Path, identity: str, fresh: _Run) -> _Run:
    arrays, plain = _read(path, identity)
    leaves, tree = jax.tree.flatten(fresh.arrays)
    values = [jnp.asarray(arrays[f"leaf_{i}"]) for i in range(len(leaves))]
    fresh.variables, fresh.state, fresh.best = jax.tree.unflatten(tree, values)
    for name in _PLAIN:
        setattr(fresh, name, plain[name])
    return fresh
