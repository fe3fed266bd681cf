"""Intervals that hold with 95 %: of a share, of a median, of what two shares differ by, of more."""

from collections.abc import Callable, Sequence
from statistics import NormalDist

import numpy as np

LEVEL = 0.95
_Z = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)


def wilson(hits: int, count: int) -> tuple[float, float]:
    """Wilson's score interval of a share, ends between 0 and 1 (Wilson 1927).

    Args:
      hits: number of successes.
      count: number of trials, at least 1.
    """
    if not 0 <= hits <= count or count < 1:
        raise ValueError(f"hits must lie between 0 and a count of at least 1, got {hits}, {count}")
    share, weight = hits / count, _Z**2 / count
    middle = share + 0.5 * weight
    half = _Z * np.sqrt(share * (1.0 - share) / count + 0.25 * weight / count)
    low, high = (middle - half) / (1.0 + weight), (middle + half) / (1.0 + weight)
    # Rounding would leave ends just beside 0 and 1.
    return (0.0 if hits == 0 else float(low)), (1.0 if hits == count else float(high))


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Ends between which the median lies, whatever the distribution; ``None`` below six values.

    They are order statistics: the number of values below the median is binomial with 1/2.
    """
    ordered = np.sort(np.asarray(values, float))
    count = len(ordered)
    # P(fewer than k of them lie below the median), k = 1, 2, ...; log to stay in range.
    logs = np.cumsum(np.log(np.arange(1, count + 1, dtype=float)))
    factorial = np.r_[0.0, logs]
    terms = factorial[count] - factorial - factorial[::-1] - count * np.log(2.0)
    below = np.cumsum(np.exp(terms))
    outside = int(np.searchsorted(below, 0.5 * (1.0 - LEVEL), side="right"))
    if outside == 0:
        return None
    return float(ordered[outside - 1]), float(ordered[count - outside])


def paired_difference(first: Sequence[bool], second: Sequence[bool]) -> tuple[float, float, float]:
    """What the share of the second lies above that of the first in the same trials.

    Newcombe's hybrid score interval for paired shares (Statistics in Medicine 17, 1998, 2635-2650,
    method 10): it keeps its level near 0 and 1 and where no pair differs.

    Args:
      first: success of each trial, one way.
      second: success of the same trials, the other way.

    Returns:
      Difference, and the ends of its interval.
    """
    one, two = np.asarray(first, bool), np.asarray(second, bool)
    if one.shape != two.shape or one.ndim != 1 or not len(one):
        raise ValueError(f"wanted two equally long lists of trials, got {one.shape}, {two.shape}")
    n = len(one)
    both, neither = int((one & two).sum()), int((~one & ~two).sum())
    only_one, only_two = int((one & ~two).sum()), int((~one & two).sum())
    share_one, share_two = (both + only_one) / n, (both + only_two) / n
    (low_one, high_one), (low_two, high_two) = wilson(int(one.sum()), n), wilson(int(two.sum()), n)
    margins = float(one.sum()) * float((~one).sum()) * float(two.sum()) * float((~two).sum())
    excess = float(both * neither - only_one * only_two)
    if excess > 0:
        excess = max(excess - 0.5 * n, 0.0)
    phi = excess / np.sqrt(margins) if margins > 0 else 0.0

    def reach(a: float, b: float) -> float:
        return float(np.sqrt(max(a * a - 2.0 * phi * a * b + b * b, 0.0)))

    difference = share_two - share_one
    low = difference - reach(share_two - low_two, high_one - share_one)
    high = difference + reach(high_two - share_two, share_one - low_one)
    return difference, low, high


def bootstrap(
    statistic: Callable[..., np.ndarray], *samples: Sequence[float] | np.ndarray, draws: int = 2000
) -> tuple[float, float]:
    """Ends of a statistic's interval by the percentile bootstrap, with fixed draws.

    Args:
      statistic: of samples (draws, n) -> (draws,).
      samples: (n,) each; paired: one draw takes the same rows of all of them.
      draws: number of resamples.
    """
    values = [np.asarray(sample, float) for sample in samples]
    count = len(values[0])
    rows = np.random.default_rng(0).integers(0, count, (draws, count))
    low, high = np.quantile(
        statistic(*(value[rows] for value in values)),
        [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL],
    )
    return float(low), float(high)
