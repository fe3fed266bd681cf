"""The QP with general rows in the coordinates that its solvers work in, and what judges a point.

M = m + n rows, the box after those of C. Every row of C has unit length, and x is measured in
units of its own expected size, the cost in units of its largest term there. So a common factor of
H and q, or another unit of x, changes nothing. Fixed variables are taken out.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class RowData(NamedTuple):
    """A problem in the caller's units, or a change of one; H symmetric, the box's bounds last."""

    H: Float[Array, "n n"]
    q: Float[Array, "n"]
    C: Float[Array, "m n"]
    low: Float[Array, "M"]
    high: Float[Array, "M"]


class RowProblem(NamedTuple):
    """Scaled problem; the box's rows follow those of C."""

    H: Float[Array, "n n"]
    q: Float[Array, "n"]
    C: Float[Array, "m n"]
    low: Float[Array, "M"]
    high: Float[Array, "M"]
    has_low: Bool[Array, "M"]
    has_high: Bool[Array, "M"]
    equal: Bool[Array, "M"]

    def rows(self, x: Array) -> Array:
        """Values (m + n,) of rows and box."""
        return jnp.concatenate([self.C @ x, x])

    def normal(self, row: Array) -> Array:
        """One of the rows, (n,)."""
        m, n = self.C.shape
        of_box = (jnp.arange(m, m + n) == row).astype(self.q.dtype)
        return of_box if m == 0 else jnp.where(row < m, self.C[jnp.minimum(row, m - 1)], of_box)

    def adjoint(self, y: Array) -> Array:
        """Transposed rows times multipliers (m + n,)."""
        m = self.C.shape[0]
        return self.C.T @ y[:m] + y[m:]

    def gram(self, w: Array) -> Array:
        """Transposed rows times weights (m + n,) times rows."""
        m = self.C.shape[0]
        return (self.C.T * w[None, :m]) @ self.C + jnp.diag(w[m:])

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (m + n,), infinite where there is none."""
        low = jnp.where(self.has_low | self.equal, self.low, -jnp.inf)
        return low, jnp.where(self.has_high | self.equal, self.high, jnp.inf)

    def errors(self, x: Array, y: Array) -> Array:
        """``kkt_errors`` of a point and its multipliers."""
        data = RowData(self.H, self.q, self.C, *self.bounds())
        one = jnp.ones_like(data.low)
        x = snapped(x)
        return kkt_errors(data, one[: len(x)], one, x, y)[0]


class RowScaling(NamedTuple):
    """From the scaled problem back to the caller's.

    Attributes:
      x: (n,) x = x_hat * x + at.
      multipliers: (m + n,) of the rows and the box.
      values: (m + n,) of the values of rows and box.
      at: (n,) values of the fixed variables, 0 elsewhere.
      fixed: (n,) variables whose bounds are equal.
      immovable: (m,) rows that no free variable can move.
    """

    x: Float[Array, "n"]
    multipliers: Float[Array, "M"]
    values: Float[Array, "M"]
    at: Float[Array, "n"]
    fixed: Bool[Array, "n"]
    immovable: Bool[Array, "m"]


def snapped(x: Float[Array, "n"]) -> Float[Array, "n"]:
    """The scaled point, what is rounding beside its expected size 1 set to 0.

    At the tip of a friction cone all terms of a row vanish: there nothing but 0 keeps it.
    """
    rounding = 16.0 * x.shape[0] ** 0.5 * float(jnp.finfo(x.dtype).eps)
    return jnp.where(jnp.abs(x) <= rounding, 0.0, x)


def variable_units(
    H: Float[Array, "n n"], C: Float[Array, "m n"], free: Bool[Array, "n"]
) -> Float[Array, "n"]:
    """Units d (n,) of the variables: by Jacobi where there is curvature, by the rows elsewhere."""
    eps = jnp.finfo(H.dtype).eps
    curvature = jnp.diagonal(H)
    largest = jnp.max(jnp.where(free, curvature, 0.0), initial=0.0)
    curved = (curvature > eps * largest) & (largest > 0)
    d = jnp.where(curved, jnp.sqrt(largest / jnp.where(curved, curvature, 1.0)), 1.0)
    if C.shape[0] == 0:
        return d
    # Ruiz equilibration of the columns that H says nothing about.
    size = jnp.abs(C) * free[None]
    for _ in range(3):
        row = jnp.max(size * d[None], axis=1, keepdims=True)
        column = jnp.max(size / jnp.where(row > 0, row, 1.0), axis=0)
        d = jnp.where(curved | ~(column > 0), d, 1.0 / jnp.where(column > 0, column, 1.0))
    return d


def scale_rows(data: RowData, *, equilibrate: bool = True) -> tuple[RowProblem, RowScaling]:
    """Scaled problem of finite data with consistent bounds.

    ``equilibrate`` is for variables without curvature, whose unit then comes from the rows.
    """
    H, q, C, low, high = data
    m = C.shape[0]
    fixed = low[m:] == high[m:]
    free = ~fixed
    at = jnp.where(fixed, low[m:], 0.0)
    d = variable_units(H, C[: len(C) * equilibrate], free)
    # Fixed variables leave: their columns act through q and the rows' bounds.
    linear = jnp.where(free, q + H @ at, 0.0) * d
    C_free = C * d[None] * free[None]
    # Measured by the largest entry: the squares of very small or large ones are 0 or infinite.
    largest = jnp.max(jnp.abs(C_free), axis=1)
    immovable = largest == 0
    largest = jnp.where(immovable, 1.0, largest)
    length = largest * jnp.linalg.norm(C_free / largest[:, None], axis=1)
    length = jnp.where(immovable, 1.0, length)
    shift = jnp.concatenate([C @ at, at])
    off = jnp.concatenate([immovable, fixed])
    unit_of_row = jnp.concatenate([length, d])
    low_hat, high_hat = (low - shift) / unit_of_row, (high - shift) / unit_of_row

    h = jnp.max(jnp.where(free, jnp.diagonal(H) * d**2, 0.0), initial=0.0)
    slope = jnp.max(jnp.abs(linear))
    lonely = free & ~H.any(axis=0) & ~C_free.any(axis=0)
    apart = jnp.concatenate([immovable, fixed | lonely])
    sigma = _expected_size(slope, h, low_hat, high_hat, apart, m)
    # A variable that no row and no other variable meets is as large as its own box.
    sides = jnp.abs(jnp.stack([low[m:], high[m:]]))
    box = jnp.max(jnp.where(jnp.isfinite(sides), sides, 0.0), axis=0)
    own_unit = jnp.where(lonely & (box > 0), box / (d * sigma), 1.0)
    d, linear = d * own_unit, linear * own_unit
    slope = jnp.max(jnp.abs(linear))
    unit_of_row = jnp.concatenate([length, d])
    low_hat, high_hat = (low - shift) / unit_of_row, (high - shift) / unit_of_row
    cost = jnp.maximum(h * sigma, slope)
    cost = jnp.where(cost > 0, cost, 1.0)
    own = jnp.where(h > 0, h, 1.0) * (sigma / cost)  # diagonal of a fixed variable

    low_hat, high_hat = low_hat / sigma, high_hat / sigma
    equal = (low == high) & ~off
    problem = RowProblem(
        H=H * (d[:, None] * d[None]) * (free[:, None] & free[None]) * (sigma / cost)
        + jnp.diag(jnp.where(fixed, own, 0.0)),
        q=linear / cost,
        C=C_free / length[:, None],
        low=jnp.where(jnp.isfinite(low_hat), low_hat, 0.0),
        high=jnp.where(jnp.isfinite(high_hat), high_hat, 0.0),
        has_low=jnp.isfinite(low_hat) & ~equal & ~off,
        has_high=jnp.isfinite(high_hat) & ~equal & ~off,
        equal=equal,
    )
    return problem, RowScaling(
        x=d * sigma,
        multipliers=cost / unit_of_row,
        values=sigma * unit_of_row,
        at=at,
        fixed=fixed,
        immovable=immovable,
    )


def _expected_size(slope: Array, h: Array, low: Array, high: Array, off: Array, m: int) -> Array:
    """Size of x, in units d: that of H^-1 q, unless bounds force another one."""
    tiny = jnp.finfo(low.dtype).tiny
    free_size = jnp.where(h > 0, slope / jnp.where(h > 0, h, 1.0), jnp.where(slope > 0, jnp.inf, 0))
    sides = jnp.stack([low, high])
    present = jnp.isfinite(sides) & ~off[None]
    largest = jnp.max(jnp.where(present, jnp.abs(sides), 0.0), initial=0.0)
    # Bounds that keep x from 0.
    least = jnp.max(jnp.where(off, 0.0, jnp.maximum(jnp.maximum(low, -high), 0.0)), initial=0.0)
    size = jnp.where(largest > 0, jnp.minimum(free_size, largest), free_size)
    size = jnp.maximum(size, least)
    return jnp.where((size > tiny) & jnp.isfinite(size), size, 1.0)


def kkt_errors(
    data: RowData,
    d: Float[Array, "n"],
    units: Float[Array, "M"],
    x: Float[Array, "n"],
    y: Float[Array, "M"],
) -> tuple[Float[Array, "3"], Float[Array, "M"], Float[Array, "M"]]:
    """Primal, dual and gap of a point inside the box, relative, each by its own terms.

    1. primal: of every row, violation / (|bound| + |C| |x|).
    2. dual: of every variable, |H x + q + C^T y| / (|H| |x| + |q| + |C^T| |y|).
    3. gap: (sum of |multiplier| slack, and of dual residual |x|) / (|x^T H x| + |q|^T |x|).

    Component by component, so neither the size of the cost nor the unit of any variable or row
    matters. What rounding of the largest terms leaves is none of these. For that, ``d`` are the
    expected sizes of the variables, 0 for those that are fixed, and ``units`` those of rows and box
    for x = d. Far out every row holds to within the rounding of its terms, and every slope is lost
    in that of H x: there the sums of terms count, not the sizes, and nothing is rounding. A
    multiplier at a side that does not exist counts as 0, and what holds a variable at
    its bound is the rest of its equation: the multipliers that come back are those judged; the
    values (m + n,) of rows and box follow.
    """
    H, q, C, low, high = data
    m, n = C.shape
    rounding = 4.0 * n**0.5 * float(jnp.finfo(q.dtype).eps)
    y = jnp.where(jnp.where(y > 0, high < jnp.inf, low > -jnp.inf), y, 0.0)
    y_rows, y_box, size_x = y[:m], y[m:], jnp.abs(x)
    # Sums of products, not products of matrices: the sum and that of its terms in one pass.
    by_H, by_C, by_y = H * x[None], C * x[None], C * y_rows[:, None]
    Hx, value, push = by_H.sum(1), by_C.sum(1), by_y.sum(0)
    inverse = jnp.where(d > 0, 1.0 / jnp.where(d > 0, d, 1.0), 0.0)
    reach = jnp.max(size_x * inverse)
    far = is_far(reach)

    noise = jnp.where(far, 0.0, rounding * reach * units)
    violated = jnp.maximum(low[:m] - value, value - high[:m])
    bound = jnp.where(violated > 0, jnp.where(low[:m] > value, low[:m], high[:m]), 0.0)
    row_terms = jnp.where(far, jnp.abs(value), jnp.abs(by_C).sum(1))
    primal = _ratio(violated - noise[:m], jnp.abs(bound) + row_terms)

    rest = -(Hx + q + push)
    holds = jnp.where(rest > 0, x >= high[m:], x <= low[m:])
    y_box = jnp.where(holds, rest, y_box)
    y = jnp.concatenate([y_rows, y_box])
    r_dual = jnp.abs(y_box - rest)
    rounded_terms = jnp.where(far, jnp.abs(Hx), jnp.abs(by_H).sum(1)) + jnp.abs(q)
    y_terms = jnp.abs(by_y).sum(0) + jnp.abs(y_box)
    hidden = rounding * jnp.maximum(rounded_terms, jnp.max(rounded_terms * d) * inverse)
    hidden = jnp.where(far, 0.0, hidden)
    dual = _ratio(r_dual - hidden - rounding * y_terms, rounded_terms + y_terms)

    side = jnp.where(y > 0, high, low)
    slack = jnp.where(y == 0, 0.0, jnp.abs(side - jnp.concatenate([value, x])))
    # At a solution H x is -(q + C^T y); far out it may be rounding, which is no measure.
    balance = jnp.abs(q) + y_terms
    whole = jnp.abs(q) @ size_x + jnp.minimum(jnp.abs(x @ Hx), balance @ size_x)
    coarse = jnp.abs(q) + jnp.minimum(jnp.abs(Hx), balance)
    coarse = jnp.maximum(reach * (coarse @ d), whole)
    y_size = jnp.abs(y)
    open_terms = y_size @ jnp.maximum(slack - noise, 0.0)
    open_terms += jnp.maximum(r_dual - hidden, 0.0) @ size_x
    # Large multipliers that cancel one another must not hide what they leave in the cost; nor must
    # a point so far out that rounding hides a slope that goes on for ever.
    small = float(jnp.finfo(q.dtype).eps) ** 0.3
    hidden_terms = y_size @ jnp.minimum(slack, noise)
    hidden_terms += small * (jnp.minimum(r_dual, hidden) @ size_x)
    gap = _ratio(open_terms, whole) + _ratio(hidden_terms, coarse)
    eps = float(jnp.finfo(q.dtype).eps)
    drowned = rounding * jnp.max(rounded_terms * d) > jnp.max(balance * d)
    gap = jnp.where(drowned & (reach > eps**-0.5), jnp.inf, gap)
    error = jnp.stack([jnp.max(primal, initial=0.0), jnp.max(dual), gap])
    return error, y, jnp.concatenate([value, x])


def is_far(reach: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a point lies so far out, in its expected sizes, that rounding may make it right."""
    return reach > float(jnp.finfo(reach.dtype).eps) ** -0.5


def contradicts(scaling: RowScaling, data: RowData, tolerance: float) -> Bool[Array, ""]:
    """Whether a row that no free variable can move breaks its bound."""
    C, m = data.C, data.C.shape[0]
    low, high, value = data.low[:m], data.high[:m], C @ scaling.at
    over = jnp.maximum(low - value, value - high)
    bound = jnp.where(over > 0, jnp.where(low > value, low, high), 0.0)
    terms = jnp.abs(bound) + jnp.abs(C) @ jnp.abs(scaling.at)
    return (scaling.immovable & (_ratio(over, terms) > tolerance)).any()


def rows_error(
    C: Float[Array, "m n"],
    low: Float[Array, "m"],
    high: Float[Array, "m"],
    d: Float[Array, "n"],
    x: Float[Array, "n"],
) -> Float[Array, ""]:
    """The primal part of ``kkt_errors``, of the rows alone."""
    size_C = jnp.abs(C)
    terms = RowTerms(C @ x, size_C @ jnp.abs(x), size_C @ d)
    return largest_violation(terms, low, high, jnp.max(jnp.abs(x) / d), x.shape[0])


class RowTerms(NamedTuple):
    """Rows of any layout at a point.

    Attributes:
      value: of the rows.
      size: sum of the sizes of its terms.
      unit: the same for a point of the expected size.
    """

    value: Array
    size: Array
    unit: Array


def largest_violation(
    terms: RowTerms, low: Array, high: Array, reach: Float[Array, ""], n: int
) -> Float[Array, ""]:
    """The primal part of ``kkt_errors``, of n variables that reach so far in expected sizes."""
    value, size, unit = terms
    rounding = 4.0 * n**0.5 * float(jnp.finfo(value.dtype).eps)
    violated = jnp.maximum(low - value, value - high)
    far = is_far(reach)
    noise = jnp.where(far, 0.0, rounding * reach * unit)
    bound = jnp.where(violated > 0, jnp.where(low > value, low, high), 0.0)
    whole = jnp.abs(bound) + jnp.where(far, jnp.abs(value), size)
    return jnp.max(_ratio(violated - noise, whole), initial=0.0)


def _ratio(part: Array, whole: Array) -> Array:
    """Non-negative part / whole; 0 where there is no part, infinite where there is no whole.

    NaN stays NaN.
    """
    ratio = jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), jnp.inf)
    return jnp.where(part <= 0, 0.0, jnp.where(jnp.isnan(part), jnp.nan, ratio))
