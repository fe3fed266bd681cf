"""Box-constrained quadratic programs; this package knows no robot."""

from kjax.qp.problem import (
    STATUS_TEXT,
    Prepared,
    Solution,
    Status,
    kkt_residual,
    prepare,
)
from kjax.qp.solvers import solve

__all__ = ["STATUS_TEXT", "Prepared", "Solution", "Status", "kkt_residual", "prepare", "solve"]
