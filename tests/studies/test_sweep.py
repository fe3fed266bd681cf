"""The sweep's script: what it says, and what it draws from a finished sweep."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from kjax.config import SweepConfig, load_config, to_dict
from kjax.runs.sweeps import runner
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


# The script, with a stand-in for the engine.


@pytest.fixture
def engine(monkeypatch):
    """Stand in for the engine: the faster of two speeds makes seed 0 fall.

    ``chunks`` are the seeds of those that were run; Ctrl-C comes before chunk ``stop_at``.
    """
    log = SimpleNamespace(chunks=[], stop_at=None)

    class Engine:
        def run(self, episodes, on_progress):
            if len(log.chunks) == log.stop_at:
                raise KeyboardInterrupt
            seeds = [int(one.params.seed) for one in episodes]
            speeds = [float(one.goal.command.values[0, 0]) for one in episodes]
            log.chunks.append(seeds)
            rows = [
                {"fell": seed == 0 and speed > 0.2, "velocity_rmse_mps": speed}
                for seed, speed in zip(seeds, speeds, strict=True)
            ]
            return SimpleNamespace(interrupted=False, metrics=lambda: iter(rows))

    monkeypatch.setattr(runner, "build_engine", lambda sweep, spec, threads: Engine())
    return log


@pytest.fixture
def file(tmp_path):
    (tmp_path / "walk.toml").write_text("")
    path = tmp_path / "sweep.toml"
    path.write_text(SWEEP)
    return path


def test_a_sweep_leaves_its_cases_a_summary_and_a_figure_and_goes_on(
    engine, call, capsys, file, tmp_path
):
    words = (file, "--chunk", 1, "--seeds", 3, "--out", tmp_path / "out")
    engine.stop_at = 2
    assert call(sweep.main, *words) == 130
    assert "finished chunks are kept" in capsys.readouterr().out
    engine.stop_at = None
    assert call(sweep.main, *words) == 0
    assert len(engine.chunks) == 6  # two speeds by three seeds, none of them twice
    names = {path.name for path in (tmp_path / "out").iterdir() if not path.name.startswith(".")}
    assert names == {"sweep.nc", "summary.json", "figure.png", "index.html", "cache"}
    found = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert found["success"]["value"] == pytest.approx([1.0, 2 / 3], abs=1e-5)
    assert found["speed"] == [0.1, 0.3]
    with xr.open_dataset(tmp_path / "out" / "sweep.nc") as data:
        np.testing.assert_array_equal(data["fell"].sel(speed=0.3), [1, 0, 0])
        np.testing.assert_array_equal(data["velocity_rmse_mps"].sel(speed=0.1), 0.1)
    out = capsys.readouterr().out
    assert "6 episodes, 5 succeeded (stayed up), 1 fell; median RMSE of the others 0.1000" in out
    # Finished, it only draws; asked to draw, it reads no config of a robot.
    assert call(sweep.main, *words) == 0
    (tmp_path / "walk.toml").unlink()
    assert call(sweep.main, *words, "--draw") == 0
    assert len(engine.chunks) == 6


def test_all_of_it_again_when_asked(engine, call, file, tmp_path):
    words = (file, "--out", tmp_path / "out")
    assert call(sweep.main, *words) == 0
    count = len(engine.chunks)
    assert call(sweep.main, *words, "--restart") == 0
    assert len(engine.chunks) == 2 * count


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seeds", 0], "--seeds: got 0, wanted at least 1"),
        (["--engine", "bullet"], "engine: got 'bullet'"),
        (["--processes", 2], "--coordinator, --processes and --process: wanted all three"),
        (["--draw"], "--draw: "),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(engine, call, capsys, file, tmp_path, words, said):
    assert call(sweep.main, file, *words, "--out", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said in err
    assert engine.chunks == []


def test_the_points_of_a_grid_and_of_a_sample_have_a_row_each():
    metric = {"value": [[1.0, 0.5]], "low": [[0.8, 0.2]], "high": [[1.0, 0.7]]}
    grid = {"dimensions": ["speed", "height"], "speed": [0.3], "height": [0.05, 0.1],
            "success": metric}  # fmt: skip
    assert sweep.points(grid) == (
        ["speed", "height", "success"],
        [["0.3", "0.05", "1 (0.8 to 1)"], ["0.3", "0.1", "0.5 (0.2 to 0.7)"]],
    )
    flat = {part: values[0] for part, values in metric.items()}
    sample = {"dimensions": ["sample"], "speed": [0.3, 0.4], "height": [0.05, 0.1],
              "success": flat}  # fmt: skip
    header, rows = sweep.points(sample)
    assert header == ["speed", "height", "success"]
    assert rows[1] == ["0.4", "0.1", "0.5 (0.2 to 0.7)"]


@pytest.mark.parametrize("drawn", [True, False])
def test_the_page_of_a_sweep_has_a_figure_only_if_it_asks_for_one(tmp_path, drawn):
    record = {"dimensions": ["speed"], "speed": [0.3], "episodes_per_point": 2,
              "success": {"value": [1.0], "low": [0.8], "high": [1.0]},
              "provenance": {"git_revision": "abc"}}  # fmt: skip
    if drawn:
        (tmp_path / "figure.png").write_bytes(b"a picture")
    sweep.save_page(tmp_path, record, ["2 episodes"], drawn=drawn)
    text = (tmp_path / "index.html").read_text()
    assert ("<img" in text) is drawn
    assert "<td>1 (0.8 to 1)</td>" in text
