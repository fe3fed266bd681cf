"""The sweep's script: what it says, and what it draws from a finished sweep."""

import numpy as np
import xarray as xr

from kjax.studies import sweep


def test_a_sweep_says_what_success_is():
    cases = {"fell": ("case", [1.0, 0.0, 0.0]), "velocity_rmse_mps": ("case", [9.0, 0.1, 0.3])}
    line = sweep.summary_line(xr.Dataset(cases))
    assert "3 episodes, 2 succeeded (stayed up), 1 fell; median RMSE of the others 0.2000" in line
    cases["crossed"] = ("case", [np.nan, 0.0, 0.0])
    line = sweep.summary_line(xr.Dataset(cases))
    assert "0 succeeded (stayed up and crossed the field)" in line
    cases["fell"] = ("case", [1.0, 1.0, 1.0])
    assert "nan" not in sweep.summary_line(xr.Dataset(cases))
