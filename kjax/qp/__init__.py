"""Convex quadratic programs with a box, or with general rows; this package knows no robot."""

from kjax.qp.interior import RowSolution, solve_rows
from kjax.qp.problem import (
    STATUS_TEXT,
    Prepared,
    Solution,
    Status,
    kkt_residual,
    prepare,
)
from kjax.qp.solvers import solve

__all__ = [
    "STATUS_TEXT",
    "Prepared",
    "RowSolution",
    "Solution",
    "Status",
    "kkt_residual",
    "prepare",
    "solve",
    "solve_rows",
]
