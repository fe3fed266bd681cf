"""The one timing helper: what it counts, and in which order it calls."""

import time

import numpy as np
import pytest

from kjax.bench import timing


def test_calls_are_interleaved_and_the_warm_up_does_not_count():
    order = []
    calls = {name: lambda i, name=name: order.append((name, i)) for name in ("a", "b")}
    times = timing.interleaved(calls, 3, warm_up=2)
    warm = [("a", 0), ("b", 0)] * 2
    assert order == [*warm, ("a", 0), ("b", 0), ("a", 1), ("b", 1), ("a", 2), ("b", 2)]
    assert {name: values.shape for name, values in times.items()} == {"a": (3,), "b": (3,)}


def test_a_call_may_report_its_own_time():
    times = timing.interleaved({"a": lambda i: 2.0 + i}, 3, warm_up=0, measure=timing.reported)
    np.testing.assert_array_equal(times["a"], [2.0, 3.0, 4.0])


def test_a_result_is_waited_for():
    class Late:
        """As an array of JAX whose computation goes on after the call."""

        def block_until_ready(self):
            time.sleep(0.05)
            return self

    assert timing.elapsed(lambda: Late()) >= 0.05
    assert timing.elapsed(lambda late: late, Late()) >= 0.05


def test_medians_leave_out_what_disturbed_one_call(monkeypatch):
    spent = iter([9.0, 1.0, 3.0, 2.0, 50.0, 2.0])
    monkeypatch.setattr(timing, "elapsed", lambda call, index: next(spent))
    assert timing.median_us(lambda i: i, range(5), warm_up=1) == pytest.approx(2e6)
    first, second = np.array([1.0, 2.0, 30.0]), np.array([2.0, 8.0, 60.0])
    assert timing.median_ratio(first, second) == pytest.approx(0.5)
