"""Figures and summaries of sweeps, against values worked out by hand or by another formula."""

import imageio.v2 as imageio
import numpy as np
import pytest
import xarray as xr

from kjax.config import AxisConfig, FigureConfig, SweepConfig
from kjax.sim.intervals import median_interval, wilson
from kjax.viz import sweep_plots

SPEEDS, HEIGHTS, SEEDS = (0.1, 0.3, 0.5), (0.02, 0.04), 20


def sweep(**figure):
    return SweepConfig(
        base="walk.toml",
        axes={
            "height": AxisConfig(values=HEIGHTS, unit="m", label="height of blocks"),
            "speed": AxisConfig(values=SPEEDS, unit="m/s"),
        },
        seeds=SEEDS,
        figure=FigureConfig(**figure) if figure else None,
    )


@pytest.fixture(scope="module")
def dataset():
    """Of 20 seeds the first few fall, more of them the faster; the error is the seed's."""
    shape = (len(HEIGHTS), len(SPEEDS), SEEDS)
    fell = np.zeros(shape)
    for i in range(len(HEIGHTS)):
        for j in range(len(SPEEDS)):
            fell[i, j, : 4 * i + 2 * j] = 1
    rmse = np.broadcast_to(0.01 * np.arange(SEEDS), shape) + np.arange(3.0)[:, None]
    dims = ("height", "speed", "seed")
    return xr.Dataset(
        {"fell": (dims, fell), "velocity_rmse_mps": (dims, rmse)},
        {"height": list(HEIGHTS), "speed": list(SPEEDS), "seed": np.arange(SEEDS)},
    )


def stayed_up():
    """Episodes without a fall at each height and speed."""
    return SEEDS - np.array([[0, 2, 4], [4, 6, 8]])


def test_a_success_is_no_fall_and_the_field_crossed(dataset):
    np.testing.assert_array_equal(sweep_plots.success(dataset).sum("seed"), stayed_up())
    assert sweep_plots.criterion(dataset) == "stayed up"
    crossed = np.ones((2, 3, SEEDS))
    crossed[0, 0, 5:7] = [0.0, np.nan]
    across = dataset.assign(crossed=(("height", "speed", "seed"), crossed))
    good = stayed_up()
    good[0, 0] -= 2
    np.testing.assert_array_equal(sweep_plots.success(across).sum("seed"), good)
    assert "crossed the field" in sweep_plots.criterion(across)


def test_the_summary_holds_shares_and_medians_with_their_intervals(dataset):
    found = sweep_plots.sweep_summary(dataset, sweep(metrics=("success", "velocity_rmse_mps")))
    assert found["episodes_per_point"] == SEEDS
    assert found["dimensions"] == ["height", "speed"]
    np.testing.assert_array_equal(found["speed"], SPEEDS)
    np.testing.assert_allclose(found["success"]["value"], stayed_up() / SEEDS)
    for index, hits in np.ndenumerate(stayed_up()):
        interval = [found["success"][end][index] for end in ("low", "high")]
        np.testing.assert_allclose(interval, wilson(int(hits), SEEDS), atol=1e-5)  # as rounded
    # Of seeds 2 to 19 at the second speed the median is that of seeds 10 and 11.
    assert found["velocity_rmse_mps"]["value"][0, 1] == pytest.approx(1.0 + 0.105)
    interval = [found["velocity_rmse_mps"][end][0, 0] for end in ("low", "high")]
    expected = median_interval(0.01 * np.arange(SEEDS))
    # One rank of 20 apart: one interpolates between ranks, the other takes the safe one.
    np.testing.assert_allclose(interval, expected, atol=0.011)


def test_a_heat_map_shows_the_shares_over_both_axes(drawn, dataset, tmp_path):
    path = tmp_path / "figure.png"
    sweep_plots.sweep_figure(dataset, sweep(metrics=("success",), title="trot over blocks"), path)
    (figure,) = drawn
    assert figure.get_suptitle() == "trot over blocks"
    heat, bar = figure.axes
    (image,) = heat.images
    np.testing.assert_allclose(image.get_array(), stayed_up() / SEEDS)
    assert image.get_clim() == (0.0, 1.0)
    assert (heat.get_xlabel(), heat.get_ylabel()) == ("speed [m/s]", "height of blocks [m]")
    assert [label.get_text() for label in heat.get_xticklabels()] == ["0.1", "0.3", "0.5"]
    assert [label.get_text() for label in heat.get_yticklabels()] == ["0.02", "0.04"]
    assert bar.get_ylabel() == "success [-]"
    low, high = wilson(20, 20)
    assert heat.texts[0].get_text() == f"100\n±{50 * (high - low):.0f}"
    assert heat.texts[0].get_position() == (0, 0)
    assert imageio.imread(path)[..., :3].std() > 10


def test_over_one_axis_it_is_a_curve_with_its_band(drawn, dataset, tmp_path):
    flat = dataset.sel(height=0.02, drop=True)
    one = SweepConfig(
        base="walk.toml", axes={"speed": sweep().axes["speed"]}, seeds=SEEDS,
        figure=FigureConfig(metrics=("success", "velocity_rmse_mps")),
    )  # fmt: skip
    sweep_plots.sweep_figure(flat, one, tmp_path / "figure.png")
    share, error = drawn[0].axes
    np.testing.assert_array_equal(share.lines[0].get_xdata(), SPEEDS)
    np.testing.assert_allclose(share.lines[0].get_ydata(), stayed_up()[0] / SEEDS)
    band = share.collections[0].get_paths()[0].vertices
    for x, hits in zip(SPEEDS, stayed_up()[0], strict=True):
        at = band[np.isclose(band[:, 0], x), 1]
        np.testing.assert_allclose((at.min(), at.max()), wilson(int(hits), SEEDS), atol=1e-9)
    np.testing.assert_allclose(error.lines[0].get_ydata(), [0.095, 1.105, 2.115])
    assert share.get_ylim() == pytest.approx((-0.03, 1.03))
    assert error.get_ylim()[0] == 0.0
    assert (error.get_xlabel(), error.get_ylabel()) == ("speed [m/s]", "velocity rmse [m/s]")


def test_an_axis_of_words_gives_a_curve_for_each(drawn, dataset, tmp_path):
    words = dataset.assign_coords(height=["anywhere", "cycle_end"]).rename(height="rule")
    axes = {"rule": AxisConfig(values=("anywhere", "cycle_end")), "speed": sweep().axes["speed"]}
    one = SweepConfig(
        base="walk.toml", axes=axes, seeds=SEEDS, figure=FigureConfig(metrics=("success",))
    )
    sweep_plots.sweep_figure(words, one, tmp_path / "figure.png")
    (axis,) = drawn[0].axes
    assert [line.get_label() for line in axis.lines] == ["anywhere", "cycle_end"]
    for line, hits in zip(axis.lines, stayed_up(), strict=True):
        np.testing.assert_allclose(line.get_ydata(), hits / SEEDS)
    assert axis.get_legend().get_title().get_text() == "rule"


def test_panels_are_rows_with_the_value_of_their_axis(drawn, dataset, tmp_path):
    wish = sweep(metrics=("success",), panels="height", x="speed")
    sweep_plots.sweep_figure(dataset, wish, tmp_path / "figure.png")
    first, second = drawn[0].axes
    assert first.get_title() == "height of blocks [m]: 0.02"
    assert second.get_title() == "height of blocks [m]: 0.04"
    np.testing.assert_allclose(second.lines[0].get_ydata(), stayed_up()[1] / SEEDS)


def test_where_all_fell_there_is_no_median(dataset):
    none = dataset.assign(fell=xr.ones_like(dataset["fell"]))
    found = sweep_plots.sweep_summary(none, sweep(metrics=("velocity_rmse_mps",)))
    assert np.isnan(found["velocity_rmse_mps"]["value"]).all()


def test_a_sweep_that_asks_for_no_figure_gets_none(drawn, dataset, tmp_path):
    sweep_plots.sweep_figure(dataset, sweep(), tmp_path / "figure.png")
    assert drawn == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("figure", "message"),
    [
        ({"x": "sped"}, r"figure: no axis named 'sped', there are height, speed"),
        ({"panels": "seed"}, r"no axis named 'seed'"),
        ({"metrics": ("velocity_rmse",)}, r"no metric named 'velocity_rmse'; wanted 'success' or"),
    ],
)
def test_an_axis_or_metric_that_is_none_is_refused(drawn, dataset, tmp_path, figure, message):
    with pytest.raises(ValueError, match=message):
        sweep_plots.sweep_figure(dataset, sweep(**figure), tmp_path / "figure.png")
    assert not (tmp_path / "figure.png").exists()


@pytest.mark.parametrize(
    ("metric", "shown"),
    [
        ("pitch_max_deg", "pitch max [deg]"),
        ("foot_slip_m", "foot slip [m]"),
        ("pitch_settle_s", "pitch settle [s]"),
        ("velocity_rmse_mps", "velocity rmse [m/s]"),
        ("qp_unsolved", "qp unsolved [-]"),
    ],
)
def test_a_metric_s_unit_is_read_off_its_name(metric, shown):
    assert sweep_plots._quantity(metric) == shown
