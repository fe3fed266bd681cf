"""From a sweep's file to its cases, and what it says where that cannot be."""

import re

import numpy as np
import pytest

from kjax.config import ConfigError, SweepConfig, load_config
from kjax.runs.sweeps.grid import evaluate, plan

SWEEP = """
base = "walk.toml"
seeds = 2
first_seed = 5
[axes.speed]
values = [0.2, 0.4]
unit = "m/s"
[axes.duty]
low = 0.1
high = 0.3
count = 3
[set]
"command.v_x" = [0.0, "= speed"]
"gaits.bound.period" = "= duty * 0.4 / 2 + 0.25"
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "walk.toml").write_text("[command]\ntimes = [0.0, 1.0]\nv_x = [0.0, 0.0]\n")
    path = tmp_path / "sweep.toml"
    path.write_text(SWEEP)
    return path


def test_a_grid_is_every_value_with_every_other_and_every_seed(file):
    cases = plan(load_config(SweepConfig, file), file)
    assert cases.dims == ("speed", "duty", "seed")
    assert cases.shape == (2, 3, 2)
    assert len(cases.cases) == 12
    at = np.empty(12, object)
    at[:] = cases.cases
    one = at.reshape(cases.shape)[1, 2, 1]
    assert one.command.v_x == (0.0, 0.4)
    assert one.gaits.bound.period == pytest.approx(0.31, abs=1e-12)
    assert (one.seed, one.terrain.seed) == (6, 6)
    dims, values, unit = cases.coords["duty"]
    assert dims == ("duty",)
    np.testing.assert_allclose(values, [0.1, 0.2, 0.3])
    assert cases.coords["speed"][2] == "m/s"
    assert unit == "-"


def test_a_sample_is_drawn_from_the_ranges_and_again_the_same(file):
    file.write_text(
        SWEEP.replace("values = [0.2, 0.4]", "low = 0.2\nhigh = 0.4").replace("count = 3", "")
        .replace("seeds = 2", "seeds = 1\nsample = 40")
    )  # fmt: skip
    sweep = load_config(SweepConfig, file)
    cases, again = plan(sweep, file), plan(sweep, file)
    assert cases.cases == again.cases
    assert cases.dims == ("sample", "seed")
    speeds = [case.command.v_x[1] for case in cases.cases]
    np.testing.assert_array_equal(speeds, cases.coords["speed"][1])
    assert 0.2 <= min(speeds) < 0.23
    assert 0.37 < max(speeds) <= 0.4


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"= speed"', '"= sped"', r"set\.command\.v_x: no axis named 'sped'"),
        ('"= speed"', '"= __import__(1)"', r"wanted literals, axes and"),
        ('"= speed"', '"= speed +"', r"wanted literals, axes and"),
        (
            "duty * 0.4",
            "-2 + duty * 0.4",
            r"at speed = 0\.2, duty = 0\.1: .*gaits\.bound\.period: got .*greater than 0",
        ),
        (
            "duty * 0.4",
            "0.02 * duty - 0.46",
            r"at speed = 0\.2, duty = 0\.1: gaits\.bound: offset and duty leave a .* shorter than",
        ),
        ('"= speed"', '"fast"', r"at speed = 0\.2.*command\.v_x"),
        ('"command.v_x"', '"command.velocity"', r"command\.velocity: unknown key"),
        (
            "duty * 0.4",
            "0.4 / (duty - 0.1)",
            r"gaits\.bound\.period: got '= 0\.4 / \(duty - 0\.1\) .*"
            r"divides by zero at speed = 0\.2, duty = 0\.1",
        ),
        ("duty * 0.4", "1e308 * 1e308 * duty", r"bound\.period: got .* no finite number at speed"),
        ("count = 3", "", r"axes\.duty: a grid needs a count"),
        ("values = [0.2, 0.4]", "", r"axes\.speed: give either values, or low and high"),
        ("high = 0.3", "high = 0.05", r"low must be below high"),
        ("seeds = 2", "seed = 2", r"seed: unknown key.*did you mean 'seeds'"),
        ("axes.speed", "axes.seed", r"axes\.seed: wanted a name"),
        ("walk.toml", "run.toml", r"run\.toml: no such file"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_key(file, old, new, said):
    file.write_text(SWEEP.replace(old, new))
    with pytest.raises(ConfigError, match=said) as error:
        plan(load_config(SweepConfig, file), file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["= word * 2", "= word + word", "= -word", "= 1 + 2j", "= True"])
def test_words_are_not_counted_with(text):
    with pytest.raises(ConfigError, match=r"set\.key: got '= .*wanted literals"):
        evaluate(text[1:].strip(), {"word": "flight", "flag": True}, "set.key")
    assert evaluate("word", {"word": "flight"}, "set.key") == "flight"


FIGURE = """
[figure]
metrics = ["success", "pitch_p95_deg"]
x = "speed"
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("pitch_p95_deg", "pitch_95_deg",
         r"figure\.metrics: no metric named 'pitch_95_deg'; did you mean 'pitch_p95_deg'\?"),
        ("pitch_p95_deg", "field_pitch_p95_deg", r"figure\.metrics: no metric named 'field_pitch"),
        ("pitch_p95_deg", "plan_ms_median", r"figure\.metrics: no metric named 'plan_ms_median'"),
        ('x = "speed"', 'x = "sped"', r"figure\.x: no axis named 'sped', there are speed, duty"),
        ('x = "speed"', 'y = "seed"', r"figure\.y: no axis named 'seed', there are speed, duty"),
        ('x = "speed"', 'panels = "x"', r"figure\.panels: no axis named 'x'"),
    ],
)  # fmt: skip
def test_a_figure_that_cannot_be_drawn_is_refused_before_anything_walks(file, old, new, said):
    file.write_text(SWEEP + FIGURE)
    assert len(plan(load_config(SweepConfig, file), file).cases) == 12
    file.write_text(SWEEP + FIGURE.replace(old, new))
    with pytest.raises(ConfigError, match=said) as error:
        plan(load_config(SweepConfig, file), file)
    assert "\n" not in str(error.value)


def test_the_shipped_sweeps_can_be_planned(repository):
    for file in sorted((repository / "configs" / "sweeps").glob("*.toml")):
        assert plan(load_config(SweepConfig, file, {"seeds": 1}), file).cases, file


def test_expressions_are_arithmetic():
    names = {"a": 3.0, "b": 2.0}
    assert evaluate("(a + 1) / b - -2 * a", names, "key") == pytest.approx(8.0)


def test_the_example_of_the_docs_walks_a_shipped_config_from_any_folder(repository, tmp_path):
    text = (repository / "docs" / "sweeps.md").read_text(encoding="utf-8")
    example = re.search(r"```toml\n(.*?)```", text, re.S).group(1)
    path = tmp_path / "mine.toml"
    path.write_text(example)
    cases = plan(load_config(SweepConfig, path), path)
    assert cases.shape == (3, 32)
    assert {case.terrain.kind for case in cases.cases} != {"flat"}
    assert [cases.cases[32 * i].command.v_x[1] for i in range(3)] == [0.2, 0.4, 0.6]
