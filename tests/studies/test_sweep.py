"""The sweep's script: what it says, and what it draws from a finished sweep."""

import json

import numpy as np
import pytest
import xarray as xr

from kjax.config import SweepConfig, load_config, to_dict
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


# A finished sweep is drawn again as itself, and as no other.

SWEEP = """
base = "walk.toml"
seeds = 2
[axes.speed]
values = [0.1, 0.3]
unit = "m/s"
[set]
"command.times" = [0.0]
"command.v_x" = ["= speed"]
[figure]
metrics = ["success"]
title = "one"
"""


@pytest.fixture
def drawn(tmp_path):
    """Draw a finished sweep with a file of this text."""
    (tmp_path / "walk.toml").write_text("")
    file = tmp_path / "sweep.toml"

    def config(text):
        file.write_text(text)
        return load_config(SweepConfig, file)

    made = config(SWEEP)
    xr.Dataset(
        {name: (("speed", "seed"), np.zeros((2, 2))) for name in ("fell", "velocity_rmse_mps")},
        {"speed": [0.1, 0.3], "seed": [0, 1]},
        attrs={"sweep": json.dumps(to_dict(made)), "provenance": "{}"},
    ).to_netcdf(tmp_path / "sweep.nc", engine="h5netcdf")
    return lambda text: sweep.draw(config(text), tmp_path, str(file))


def test_a_sweep_may_be_drawn_with_another_figure(drawn, tmp_path):
    drawn(SWEEP.replace('"one"', '"two"').replace("seeds = 2", "seeds = 4"))
    assert (tmp_path / "figure.png").exists()


@pytest.mark.parametrize(
    ("old", "new"),
    [("[0.1, 0.3]", "[0.1, 0.4]"), ('"= speed"', '"= 2 * speed"'), ("walk.toml", "other.toml")],
)
def test_a_sweep_is_not_drawn_as_another_one(drawn, capsys, tmp_path, old, new):
    with pytest.raises(SystemExit) as caught:
        drawn(SWEEP.replace(old, new))
    assert caught.value.code == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert "holds another sweep" in text
    assert not (tmp_path / "figure.png").exists()
