"""All figures have one look, and leave the caller's matplotlib as it was."""

import ast
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

import kjax
from kjax.viz.style import COLOURS, STYLE, figure_style


def test_a_figure_has_the_style_and_leaves_the_callers_alone():
    before = dict(plt.rcParams)

    @figure_style
    def draw(height):
        return [plt.rcParams[name] for name in STYLE], height

    seen, height = draw(height=3.0)
    assert seen == list(STYLE.values())
    assert height == 3.0
    assert dict(plt.rcParams) == before


def test_colours_differ():
    assert len(set(COLOURS)) == len(COLOURS) >= 8


DRAWS = [
    path
    for path in sorted(Path(kjax.__file__).parent.rglob("*.py"))
    if "plt.subplots(" in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("path", DRAWS, ids=lambda path: path.stem)
def test_every_figure_of_the_package_is_in_the_style(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        text = ast.unparse(function)
        if "plt.subplots(" in text and not any(
            isinstance(node, ast.FunctionDef) and node is not function
            for node in ast.walk(function)
        ):
            assert "figure_style" in text or "rc_context" in text, function.name
