"""Nodes of a horizon that runs through contact modes, and the list of feet that press in them.

The horizon has one length for all gaits. Nodes are cut at the borders of phases, so that in each of
them the same legs stand; a flight is one node. Legs in the air are no variables: the feet that
press, over all nodes, are a list padded to one length, so that one program serves all gaits.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from kjax import gait


class Grid(NamedTuple):
    """Grid of the horizon, K nodes; unused ones have no length and no stance.

    Attributes:
      length: (K,) [s].
      end: (K,) time from now to the node's end [s].
      phase: (K,) index of the gait's phase.
      cycle: (K,) its cycle.
      begin: (K,) time from now to the start of the node's phase; negative for the present one [s].
      slot: (K,) how many phases ahead it is, 0 for the present one.
      stance: (K, 4) legs that stand.
    """

    length: Float[Array, "K"]
    end: Float[Array, "K"]
    phase: Int[Array, "K"]
    cycle: Int[Array, "K"]
    begin: Float[Array, "K"]
    slot: Int[Array, "K"]
    stance: Bool[Array, "K 4"]


class FootNodes(NamedTuple):
    """Feet that press, F of them, node by node.

    Attributes:
      node: (F,) index of the node.
      leg: (F,) index of the leg.
      used: (F,) whether it is one; the rest is padding.
    """

    node: Int[Array, "F"]
    leg: Int[Array, "F"]
    used: Bool[Array, "F"]


def node_at(
    end: Float[Array, "K"], time: Float[Array, "n"]
) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Node that holds at each time, and whether there is one; beyond the last, that one.

    Args:
      end: of the nodes [s].
      time: from the same moment [s].
    """
    node = jnp.sum(time[:, None] >= end[None], axis=1)
    last = end.shape[0] - 1
    return jnp.minimum(node, last), node <= last


def build_grid(
    schedule: gait.Schedule,
    clock: gait.Clock,
    count: int,
    *,
    node_dt: Float[Array, ""] | float,
    horizon: Float[Array, ""] | float,
    shortest: float,
) -> Grid:
    """Grid from now on, at most one gait cycle long.

    Args:
      schedule: of all gaits.
      clock: now.
      count: number K of nodes; where they do not suffice the horizon is shorter.
      node_dt: longest node where two feet stand, longer in proportion where more do [s].
      horizon: length [s].
      shortest: least time left of the present phase [s].
    """
    ahead = gait.preview(schedule, clock, shortest)
    duration = jnp.clip(horizon - ahead.begin, 0.0, ahead.duration)
    standing = schedule.stance[clock.gait, ahead.phase]
    count_now = standing.sum(axis=1)
    # As many forces whether two feet stand or four.
    longest = node_dt * jnp.maximum(count_now, 2) / 2
    wanted = jnp.where(count_now > 0, jnp.ceil(duration / longest - 1e-4), 1.0)
    # A sliver of a phase, left over by rounding, is no node.
    number = jnp.where(duration > 1e-5, jnp.maximum(wanted, 1.0), 0.0).astype(jnp.int32)
    last = jnp.cumsum(number)
    node = jnp.arange(count)
    slot = jnp.minimum(jnp.sum(node[:, None] >= last[None], axis=1), len(last) - 1)
    used = node < last[-1]
    length = jnp.where(used, (duration / jnp.maximum(number, 1))[slot], 0.0)
    return Grid(
        length=length,
        end=jnp.cumsum(length),
        phase=ahead.phase[slot],
        cycle=ahead.cycle[slot],
        begin=(ahead.begin - ahead.passed)[slot],
        slot=slot,
        stance=standing[slot] & used[:, None],
    )


def list_feet(stance: Bool[Array, "K 4"], count: int) -> FootNodes:
    """The first ``count`` feet that press, in the order of the nodes."""
    nodes = stance.shape[0]
    (flat,) = jnp.nonzero(stance.reshape(-1), size=count, fill_value=4 * nodes)
    used = flat < 4 * nodes
    flat = jnp.where(used, flat, 0)
    return FootNodes(node=flat // 4, leg=flat % 4, used=used)
