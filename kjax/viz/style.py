"""One look for all figures: colours, sizes and lines, legible at the width of a page.

@figure_style
def figure(...): ...
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from cycler import cycler

BLUE, RED, GREY, DARK = "#2b6cb0", "#c53030", "#a0aec0", "#2d3748"
ORANGE, GREEN, PURPLE, TEAL = "#dd6b20", "#2f855a", "#6b46c1", "#2c7a7b"
COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, TEAL, DARK, GREY)
STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.prop_cycle": cycler(color=COLOURS),
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "lines.linewidth": 0.9,
    "savefig.dpi": 120,
}

P = ParamSpec("P")
R = TypeVar("R")


def figure_style(draw: Callable[P, R]) -> Callable[P, R]:
    """``draw`` in the common style, whatever the caller's matplotlib is set to."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> R:
        with plt.rc_context(STYLE):
            return draw(*args, **kwargs)

    return styled
