"""Rows in the LMPC: carried warm start, ADMM, the refusal of projected gradient."""

import pytest
from pydantic import ValidationError

from kjax.config import LmpcConfig


@pytest.mark.parametrize("rows", [{"friction": 0.6}, {"torque_fraction": 0.95}])
def test_projected_gradient_is_refused_with_rows_and_the_message_says_what_to_set(rows):
    with pytest.raises(ValidationError, match=r"solver = 'tableau' or 'admm', or friction"):
        LmpcConfig(solver="projected_gradient", **rows)


@pytest.mark.parametrize("solver", ["tableau", "admm"])
def test_the_other_solvers_keep_rows(solver):
    assert LmpcConfig(solver=solver, friction=0.6).solver == solver
