"""A batch on a CPU in pieces that stay in the cache, and that wait for fewer stragglers."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

from kjax.precision import full_precision

CHUNK = 16  # problems at once; 8 to 32 are alike for 24 variables, all at once is slower


def in_chunks(function: Callable[..., Any], chunk: int = CHUNK) -> Callable[..., Any]:
    """``function`` of pytrees whose ``vmap`` runs ``chunk`` at a time on a CPU.

    A loop under ``vmap`` runs as long as its slowest member, and a thousand tableaux do not fit in
    a cache. On an accelerator the batch stays whole.
    """
    function = full_precision(function)  # vmap may trace it after its caller has returned
    whole = custom_vmap(function)

    @whole.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        leaves, tree = jax.tree.flatten(args)
        batched = jax.tree.leaves(in_batched)
        moving = [leaf for leaf, is_batched in zip(leaves, batched, strict=True) if is_batched]

        def one(moving: list[Any]) -> Any:
            rest = iter(moving)
            merged = [
                next(rest) if is_batched else leaf
                for leaf, is_batched in zip(leaves, batched, strict=True)
            ]
            return function(*jax.tree.unflatten(tree, merged))

        if axis_size > chunk and jax.default_backend() == "cpu":
            out = jax.lax.map(one, moving, batch_size=chunk)
        else:
            out = jax.vmap(one)(moving)
        return out, jax.tree.map(lambda _: True, out)

    return whole


def where_needed(
    needed: Bool[Array, ""], function: Callable[..., Any], value: Any, *args: Any
) -> Any:
    """``function(value, *args)`` where it is needed, else ``value``.

    Like ``lax.cond``, which under ``vmap`` computes both sides for everyone; this computes
    ``function`` for a batch only if a member needs it, and on a CPU in pieces that hold none but
    the members that do.
    """
    function = full_precision(function)

    @custom_vmap
    def chosen(needed: Array, value: Any, args: Any) -> Any:
        return jax.lax.cond(needed, lambda: function(value, *args), lambda: value)

    @chosen.def_vmap
    def rule(axis_size: int, in_batched: Any, needed: Any, value: Any, args: Any) -> Any:
        needed, value = _spread(axis_size, (needed, value), tuple(in_batched[:2]))
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, in_batched[2])

        def some() -> Any:
            new = jax.vmap(lambda v, a: function(v, *a), in_axes=(0, axes))(value, args)
            return jax.vmap(lambda n, a, b: jax.tree.map(lambda a, b: jnp.where(n, a, b), a, b))(
                needed, new, value
            )

        def piece(order: Array, i: Array, out: Any) -> Any:
            index = jax.lax.dynamic_slice_in_dim(order, i * CHUNK, CHUNK)
            old, chosen = jax.tree.map(lambda leaf: leaf[index], (value, needed))
            mine = jax.tree.map(
                lambda leaf, there: leaf[index] if there else leaf, args, in_batched[2]
            )
            new = jax.vmap(lambda v, a: function(v, *a), in_axes=(0, axes))(old, mine)
            return jax.tree.map(
                lambda out, new, old: out.at[index].set(
                    jnp.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                ),
                out, new, old,
            )  # fmt: skip

        if axis_size > CHUNK and jax.default_backend() == "cpu":
            # Those that need it first; the last index fills the last piece up.
            order = jnp.argsort(~needed, stable=True)
            order = jnp.concatenate([order, jnp.full((CHUNK,), order[-1])])
            pieces = (needed.sum() + CHUNK - 1) // CHUNK
            out = jax.lax.fori_loop(0, pieces, lambda i, out: piece(order, i, out), value)
        else:
            out = jax.lax.cond(needed.any(), some, lambda: value)
        return out, jax.tree.map(lambda _: True, out)

    return chosen(needed, value, args)


def while_any(
    unfinished: Callable[..., Array], advance: Callable[..., Any], carry: Any, *args: Any
) -> Any:
    """``while_loop`` over ``carry = advance(carry, *args)`` as long as ``unfinished(carry)``.

    ``advance`` must leave a finished carry as it is. Under ``vmap`` that saves the comparison of
    old and new that JAX would put around every iteration.
    """
    advance, unfinished = full_precision(advance), full_precision(unfinished)

    @custom_vmap
    def run(carry: Any, args: Any) -> Any:
        return jax.lax.while_loop(unfinished, lambda c: advance(c, *args), carry)

    @run.def_vmap
    def rule(axis_size: int, in_batched: Any, carry: Any, args: Any) -> Any:
        carry = _spread(axis_size, carry, in_batched[0])
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, in_batched[1])
        step = jax.vmap(lambda c, a: advance(c, *a), in_axes=(0, axes))
        going = jax.vmap(unfinished)
        out = jax.lax.while_loop(lambda c: going(c).any(), lambda c: step(c, args), carry)
        return out, jax.tree.map(lambda _: True, out)

    return run(carry, args)


def _spread(axis_size: int, tree: Any, is_batched: Any) -> Any:
    """The tree with a leading axis on every leaf."""
    return jax.tree.map(
        lambda leaf, there: leaf if there else jnp.broadcast_to(leaf, (axis_size, *leaf.shape)),
        tree,
        is_batched,
    )
