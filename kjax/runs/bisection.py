"""The hardest value that still passes, by bisection."""

from collections.abc import Callable
from typing import NamedTuple


class Bracket(NamedTuple):
    """Between which two values the limit lies.

    Attributes:
      passed: hardest value that passed; None if even the easy end failed.
      failed: easiest value that failed; None if even the hard end passed.
    """

    passed: float | None
    failed: float | None


def bisect(passes: Callable[[float], bool], easy: float, hard: float, resolution: float) -> Bracket:
    """Narrow the limit down to a resolution; assumes that what is harder does not pass again.

    Args:
      passes: whether a value passes; asked once per value, the easy end first.
      easy: where the search begins; may be the larger number (friction).
      hard: where it ends.
      resolution: widest bracket to stop at, > 0.
    """
    if not resolution > 0:
        raise ValueError(f"resolution must be positive, got {resolution}")
    if not passes(easy):
        return Bracket(passed=None, failed=easy)
    if passes(hard):
        return Bracket(passed=hard, failed=None)
    while abs(hard - easy) > resolution * (1.0 + 1e-9):
        middle = 0.5 * (easy + hard)
        if passes(middle):
            easy = middle
        else:
            hard = middle
    return Bracket(passed=easy, failed=hard)
