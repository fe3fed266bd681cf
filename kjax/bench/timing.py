"""Wall times of calls: warmed up, until the result is ready, interleaved.

A machine drifts by tens of per cent within minutes. So calls that are compared are interleaved,
round by round, and reported as medians, and as the median of the ratios within the rounds.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np

Call = Callable[[int], Any]


def elapsed(call: Callable[..., Any], *arguments: Any) -> float:
    """Wall time of a call until its result is ready [s]."""
    begin = time.perf_counter()
    result = call(*arguments)
    if result is not None and not isinstance(result, np.ndarray):  # asking costs microseconds
        jax.block_until_ready(result)
    return time.perf_counter() - begin


def reported(call: Call, index: int) -> float:
    """The time that a call itself returns [s], as of an engine without its set-up."""
    return float(call(index))


def interleaved(
    calls: Mapping[str, Call],
    rounds: int,
    *,
    warm_up: int = 1,
    measure: Callable[[Call, int], float] = elapsed,
) -> dict[str, np.ndarray]:
    """Times (rounds,) of each call [s], all of them once a round.

    Args:
      calls: by name; each is called with the index of the round.
      rounds: that count.
      warm_up: rounds before them, which compile and do not count.
      measure: time of one call: ``elapsed``, or ``reported``.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for index in range(-warm_up, rounds):
        for name, call in calls.items():
            spent = measure(call, max(index, 0))
            if index >= 0:
                times[name].append(spent)
    return {name: np.array(values) for name, values in times.items()}


def median_us(call: Call, indices: Iterable[int], *, warm_up: int = 0) -> float:
    """Median time of a call over the indices that it is called with [us]."""
    for _ in range(warm_up):
        elapsed(call, 0)
    return 1e6 * float(np.median([elapsed(call, index) for index in indices]))


def median_ratio(first: np.ndarray, second: np.ndarray) -> float:
    """Median over the rounds of how many times as long the first took as the second [-]."""
    return float(np.median(first / second))
