"""The equations that the active rows of a solution make, for its derivative."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kjax.qp.row_problem import RowData, scale_rows


class ActiveEquations(NamedTuple):
    """H dx + A^T dy = -r_dual, A dx = r_primal in scaled coordinates; the box's rows last.

    Attributes:
      H: (n, n) Hessian.
      A: (M, n) rows, zero where not active.
      active: (M,) rows that are active.
      at_low: (M,) those at their lower side.
      unit_x: (n,) of the point.
      unit_y: (M,) of the multipliers.
      unit_row: (M,) of the rows' values.
      unit_cost: of the cost.
    """

    H: Float[Array, "n n"]
    A: Float[Array, "M n"]
    active: Bool[Array, "M"]
    at_low: Bool[Array, "M"]
    unit_x: Float[Array, "n"]
    unit_y: Float[Array, "M"]
    unit_row: Float[Array, "M"]
    unit_cost: Float[Array, ""]

    def right_sides(self, change: RowData, x: Array, y: Array) -> tuple[Array, Array]:
        """r_dual (n,) and r_primal (M,) of a change of the data; linear in it."""
        dH, dq, dC, d_low, d_high = change
        wanted = jnp.where(self.at_low, d_low, d_high)
        r_primal = wanted - jnp.concatenate([dC @ x, jnp.zeros_like(dq)])
        r_dual = 0.5 * (dH + dH.T) @ x + dq + dC.T @ y[: dC.shape[0]]
        return (
            self.unit_x * r_dual / self.unit_cost,
            jnp.where(self.active, r_primal, 0.0) / self.unit_row,
        )


def active_equations(
    data: RowData, x: Float[Array, "n"], y: Float[Array, "M"], good: Bool[Array, ""]
) -> ActiveEquations:
    """Equations at a solution x, y; those of another, harmless problem where it is not good."""
    H, q, C, low, high = data
    n = q.shape[0]
    symmetric = jnp.where(good, 0.5 * (H + H.T), jnp.eye(n, dtype=H.dtype))
    _, scaling = scale_rows(
        RowData(symmetric, *(jnp.where(good, a, 0.0) for a in (q, C, low, high)))
    )
    A = jnp.concatenate([jnp.where(good, C, 0.0), jnp.eye(n, dtype=q.dtype)])
    # A side is active where its multiplier, in units of the objective, outweighs its slack.
    value = A @ x
    force = jnp.abs(y) / scaling.multipliers
    at_low = (y < 0) & (force > jnp.abs(value - low) / scaling.values)
    at_high = (y > 0) & (force > jnp.abs(value - high) / scaling.values)
    active = (at_low | at_high | (low == high)) & good
    active &= ~jnp.concatenate([scaling.immovable, jnp.zeros((n,), bool)])
    unit_cost = scaling.multipliers[-1] * scaling.values[-1]
    return ActiveEquations(
        H=symmetric * scaling.x[:, None] * scaling.x[None] / unit_cost,
        A=jnp.where(active[:, None], A * scaling.x[None] / scaling.values[:, None], 0.0),
        active=active,
        at_low=at_low | ((low == high) & (y < 0)),
        unit_x=scaling.x,
        unit_y=scaling.multipliers,
        unit_row=scaling.values,
        unit_cost=unit_cost,
    )
