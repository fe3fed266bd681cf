"""Convex quadratic programs with a box, or with general rows; this package knows no robot."""

from kjax.qp.block_rows import BlockRows, solve_block_rows
from kjax.qp.box import METHODS, Method, solve
from kjax.qp.box_rows import BoxRowSolution, solve_rows_from_box
from kjax.qp.problem import (
    STATUS_TEXT,
    Prepared,
    Solution,
    Status,
    Warm,
    kkt_residual,
    prepare,
    start,
)
from kjax.qp.row_methods import ROW_METHODS, MethodUsed, RowMethod
from kjax.qp.rows import RowSolution, solve_rows

__all__ = [
    "METHODS",
    "ROW_METHODS",
    "STATUS_TEXT",
    "BlockRows",
    "BoxRowSolution",
    "Method",
    "MethodUsed",
    "Prepared",
    "RowMethod",
    "RowSolution",
    "Solution",
    "Status",
    "Warm",
    "kkt_residual",
    "prepare",
    "solve",
    "solve_block_rows",
    "solve_rows",
    "solve_rows_from_box",
    "start",
]
