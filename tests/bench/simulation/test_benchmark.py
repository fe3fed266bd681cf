"""What the simulation benchmark makes of its times, with stand-ins for the engines."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from kjax.bench import machine
from kjax.bench.simulation import benchmark, report

STEPS = 1000  # physics steps of a robot: 1 s, as batches below 1024 walk twice as long


@pytest.fixture
def engine(monkeypatch):
    """Stand in for the batch engine: 2 s for a run, against 1 s of the bare engine."""
    log = SimpleNamespace(fell=0)

    class Engine:
        def __init__(self, config, torques):
            self.torques = torques

        def run(self, configs):
            ticks = np.full(len(configs), STEPS // 5)
            ticks[: log.fell] //= 2
            fell = np.arange(len(configs)) < log.fell
            return SimpleNamespace(wall_time=2.0, ticks=ticks, fell=fell, torque=None)

    monkeypatch.setattr(benchmark, "BatchEngine", Engine)
    monkeypatch.setattr(benchmark, "bare_batch", lambda *arguments: lambda: 1.0)
    return log


def test_a_closed_loop_is_compared_with_the_bare_engine_step_by_step(engine):
    found = benchmark.c_batch("trot", "held", 16, 3)
    assert found["robot_steps_per_s"] == pytest.approx(16 * STEPS / 2.0)
    assert found["bare_robot_steps_per_s"] == pytest.approx(16 * STEPS / 1.0)
    assert found["over_bare"] == found["over_bare_min"] == found["over_bare_max"] == 0.5
    assert found["falls"] == 0


def test_steps_that_a_fallen_robot_does_not_make_do_not_count(engine):
    engine.fell = 8
    found = benchmark.c_batch("trot", "held", 16, 3)
    assert found["robot_steps_per_s"] == pytest.approx(12 * STEPS / 2.0)
    assert found["over_bare"] == pytest.approx(0.5 * 12 / 16)
    assert found["falls"] == 8


def test_robots_walk_alike_but_for_their_seeds():
    for gait, speed in (("trot", 0.3), ("bound", 0.5)):
        configs = benchmark.cases(gait, 3, 0.5)
        assert [config.seed for config in configs] == [0, 1, 2]
        assert {config.command.v_x for config in configs} == {(speed,)}
        assert {config.gait.names[0] for config in configs} == {gait}
        assert {config.duration for config in configs} == {0.5}


def result():
    def entry(rate):
        return {"robot_steps_per_s": rate, "bare_robot_steps_per_s": 2 * rate, "over_bare": 0.5,
                "resident_MB": 300.0}  # fmt: skip

    return {
        "threads": 2,
        "c": {
            "trot, held, 16": entry(1e5), "trot, held, 128": entry(2e5),
            "trot, every_step, 128": entry(5e4), "bound, held, 128": entry(1.5e5),
        },
        "mjx": {"16": entry(2e3)},
        "python_loop": {"robot_steps_per_s": 1e4},
    }  # fmt: skip


def test_the_ratios_that_are_quoted_are_those_of_the_largest_batch():
    found = benchmark.headline(result())
    assert found["c_batch_over_loop"] == pytest.approx(20.0)
    assert set(found.values()) == {0.5, 20.0}


def test_the_table_has_a_row_for_each_batch_and_the_loop():
    lines = report.table(result()).splitlines()
    assert len(lines) == 2 + 4 + 1 + 1
    assert lines[2] == "| C, trot, held, 16 | 100,000 | 200,000 | 0.50 | 300 |"
    assert lines[-1].startswith("| C, trot, every step, one robot in a Python loop | 10,000 |")


def test_the_figure_shows_rates_over_the_number_of_robots(monkeypatch, tmp_path):
    kept = []
    close = plt.close
    monkeypatch.setattr(plt, "close", kept.append)
    report.figure(result(), tmp_path / "figure.png")
    (axis,) = kept[0].axes
    lines = {line.get_label(): line for line in axis.lines}
    held = lines["C, torques held"]
    np.testing.assert_array_equal(held.get_xdata(), [16, 128])
    np.testing.assert_array_equal(held.get_ydata(), [1e5, 2e5])
    np.testing.assert_array_equal(lines["C, torques held, bare"].get_ydata(), [2e5, 4e5])
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("robots", "robot-steps per second")
    close(kept[0])


@pytest.mark.slow
def test_what_runs_in_a_process_of_its_own_gives_its_result_back():
    assert benchmark.elsewhere("cases('trot', 2, 0.5)[1].seed") == 1


def test_the_machine_s_gain_is_the_rate_of_two_processes_over_that_of_one(monkeypatch):
    seconds = {1: 1.0, 2: 1.25}
    monkeypatch.setattr(machine, "elapsed", lambda call, count: seconds[count])
    assert machine.two_process_speedup() == pytest.approx(1.6)


def test_memory_is_in_megabytes(monkeypatch):
    assert (
        50.0 < machine.peak_memory() < 1e6
    )  # an interpreter with JAX, and no more than a terabyte
    used = SimpleNamespace(ru_maxrss=2048)  # KiB, as Linux has it
    monkeypatch.setattr(machine.resource, "getrusage", lambda who: used)
    assert machine.peak_memory() == 2.0
