"""What the figures over many episodes draw is what they were given, with its units."""

import dataclasses

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib.colors import to_rgba

from kjax.config import RunConfig, load_config
from kjax.sim.resolve import resolve_field
from kjax.sim.series import Series
from kjax.sim.terrain import generate
from kjax.viz import report
from kjax.viz.plots import moving_mean
from kjax.viz.style import BLUE, RED

DT = 0.005  # s
CYCLE = 0.5  # s


def series(seed, seconds=4.0):
    """An episode made of smooth random curves."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, DT)
    x = np.stack([np.sin(rng.uniform(1.0, 3.0) * time + k) for k in range(6)], axis=1)
    x[:, 0] = 0.4 * time
    return Series(
        time=time,
        x=x,
        foot_force=rng.uniform(0.0, 60.0, (len(time), 4)),
        stance=rng.random((len(time), 4)) < 0.5,
        gait=np.zeros(len(time), int),
        velocity_command=np.where(time < 2.0, 0.0, 0.3),
        velocity_reference=np.where(time < 2.0, 0.0, 0.3),
    )


@pytest.fixture(scope="module")
def runs():
    return [series(seed) for seed in range(3)]


@pytest.fixture(scope="module")
def config():
    keys = {"duration": 4.0, "command.times": [0.0, 2.0], "command.v_x": [0.0, 0.3]}
    return load_config(RunConfig, None, keys)


def by_colour(axis, colour):
    return [line for line in axis.lines if to_rgba(line.get_color()) == to_rgba(colour)]


def ink(path):
    """Spread of the grey levels of a picture; of an empty page it is zero."""
    return float(imageio.imread(path)[..., :3].std())


def test_tracking_shows_the_first_run_in_colour_and_the_others_thin(drawn, runs, config, tmp_path):
    report.tracking_figure(runs, config, tmp_path / "figure.png", "trot", CYCLE)
    (figure,) = drawn
    velocity, pitch, bars = figure.axes
    assert velocity.get_ylabel() == "v_x [m/s]"
    assert pitch.get_ylabel().startswith("pitch [deg]")
    assert bars.get_xlabel().startswith("time [s]")
    assert velocity.get_title(loc="left") == "trot (coloured: the first of 3)"
    (mean,) = by_colour(velocity, BLUE)
    np.testing.assert_array_equal(mean.get_xdata(), runs[0].time)
    np.testing.assert_array_equal(mean.get_ydata(), moving_mean(runs[0].x[:, 3], 100))
    (angle,) = by_colour(pitch, BLUE)
    np.testing.assert_array_equal(angle.get_ydata(), np.degrees(runs[0].x[:, 2]))
    for line, run in zip(velocity.lines[:2], runs[1:], strict=True):
        np.testing.assert_array_equal(line.get_ydata(), moving_mean(run.x[:, 3], 100))
    for line, run in zip(pitch.lines[:2], runs[1:], strict=True):
        np.testing.assert_array_equal(line.get_ydata(), np.degrees(run.x[:, 2]))
    (command,) = [line for line in velocity.lines if line.get_label() == "command"]
    np.testing.assert_array_equal(command.get_ydata(), runs[0].velocity_command)
    # Two seconds about the step at 2 s, 0.5 s late: from 1.5 to 3.5 s.
    assert bars.get_xlim() == pytest.approx((1.5, 3.5))
    assert ink(tmp_path / "figure.png") > 10.0


def test_a_reference_is_drawn_where_it_is_not_the_command(drawn, runs, config, tmp_path):
    slewed = runs[0]._replace(velocity_reference=0.5 * runs[0].velocity_command)
    for run in (runs[0], slewed):
        report.tracking_figure([run], config, tmp_path / "figure.png", "trot", CYCLE)
    labels = [[line.get_label() for line in figure.axes[0].lines] for figure in drawn]
    assert "reference" not in labels[0]
    line = drawn[1].axes[0].lines[labels[1].index("reference")]
    np.testing.assert_array_equal(line.get_ydata(), slewed.velocity_reference)


def test_terrain_is_drawn_over_the_way_with_the_field_of_the_first_run(drawn, runs, tmp_path):
    keys = {"terrain.kind": "blocks", "terrain.count": 4, "terrain.start": 0.5, "terrain.end": 1.4}
    config = load_config(RunConfig, None, keys)
    report.terrain_figure(runs, config, tmp_path / "figure.png", "rough trot", CYCLE)
    velocity, pitch, field = drawn[0].axes
    assert field.get_xlabel() == "way [m]"
    assert field.get_ylabel() == "height [m]"
    for axis, values in (
        (velocity, moving_mean(runs[0].x[:, 3], 100)),
        (pitch, np.degrees(runs[0].x[:, 2])),
        (field, runs[0].x[:, 1]),
    ):
        (line,) = by_colour(axis, BLUE)
        np.testing.assert_array_equal(line.get_xdata(), runs[0].x[:, 0])
        np.testing.assert_array_equal(line.get_ydata(), values)
    expected = generate(resolve_field(config))
    assert len(field.patches) == len(expected.pos) == 4
    for patch, pos, size in zip(field.patches, expected.pos, expected.size, strict=True):
        low, high = patch.get_path().get_extents().get_points()
        np.testing.assert_allclose((low + high) / 2, pos[[0, 2]], atol=1e-12)
        assert high[1] - low[1] == pytest.approx(2 * size[2])  # blocks turn about z only
    assert ink(tmp_path / "figure.png") > 10.0


def test_capsules_are_circles_and_another_seed_is_another_field(drawn, runs, tmp_path):
    config = load_config(RunConfig, None, {"terrain.kind": "paper"})
    other = dataclasses.replace(config, terrain=dataclasses.replace(config.terrain, seed=1))
    for one in (config, other):
        report.terrain_figure(runs[:1], one, tmp_path / "figure.png", "rough", CYCLE)
    fields = [
        np.array([p.get_path().get_extents(p.get_patch_transform()).p0 for p in f.axes[2].patches])
        for f in drawn
    ]
    assert {type(patch).__name__ for patch in drawn[0].axes[2].patches} >= {"Circle"}
    assert fields[0].shape == fields[1].shape
    assert not np.allclose(fields[0], fields[1])


def test_a_switch_is_at_zero_and_the_median_is_bold(drawn, tmp_path):
    def constant(degrees):
        run = series(0)
        return run._replace(x=np.tile([0.0, 0.27, np.radians(degrees), 0.0, 0.0, 0.0],
                                      (len(run.time), 1)))  # fmt: skip

    groups = {
        "trot to bound": ([constant(1.0), constant(2.0), constant(6.0)], [1.0, 1.2, 1.4]),
        "bound to trot": ([], []),
    }
    report.switch_figure(groups, tmp_path / "figure.png")
    left, right = drawn[0].axes
    assert left.get_ylabel() == "pitch [deg], nose up +"
    assert left.get_xlabel() == "time since the switch [s]"
    assert left.get_title(loc="left") == "trot to bound\nn = 3"
    for line, (run, at) in zip(left.lines[:3], zip(*groups["trot to bound"], strict=True),
                               strict=True):  # fmt: skip
        np.testing.assert_array_equal(line.get_xdata(), run.time - at)
    (median,) = by_colour(left, RED)
    np.testing.assert_allclose(median.get_ydata(), 2.0)
    assert by_colour(right, RED) == []
    assert right.get_title(loc="left") == "bound to trot\nn = 0"


def test_episodes_without_a_switch_time_are_refused(drawn, tmp_path):
    with pytest.raises(ValueError, match="zip"):
        report.switch_figure({"trot": ([series(0)], [])}, tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()


def test_limits_are_bars_from_what_passed_to_what_failed(drawn, tmp_path):
    base = {"quantity": "fastest", "unit": "m/s", "easy": 0.2}
    push = {"quantity": "strongest push", "unit": "N s", "easy": 2.5}
    found = {
        "a": {**base, "title": "trot", "passed": 0.8, "failed": 0.9, "reached_mps": 0.75},
        "b": {**base, "title": "bound", "passed": None, "failed": 0.2},
        "c": {**push, "title": "trot", "passed": 40.0, "failed": None,
              "phases": [{"passed": 40.0}, {"passed": None}, {"passed": 42.5}]},
    }  # fmt: skip
    report.envelope_figure(found, tmp_path / "figure.png")
    speed, strength = drawn[0].axes
    assert (speed.get_xlabel(), strength.get_xlabel()) == ("fastest [m/s]", "strongest push [N s]")
    assert [label.get_text() for label in speed.get_yticklabels()] == ["trot", "bound"]
    marks = {line.get_marker(): line for line in speed.lines}
    np.testing.assert_array_equal(marks["o"].get_xydata(), [[0.8, 0]])
    np.testing.assert_array_equal(marks["None"].get_xdata(), [0.8, 0.9])
    np.testing.assert_array_equal(marks["x"].get_xydata(), [[0.2, 1]])
    assert [text.get_text() for text in speed.texts] == ["0.8, reached 0.75", "fails"]
    marks = {line.get_marker(): line for line in strength.lines}
    np.testing.assert_array_equal(marks[">"].get_xydata(), [[40.0, 0]])
    np.testing.assert_array_equal(marks["|"].get_xdata(), [40.0, 42.5])
