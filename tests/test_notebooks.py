"""The notebooks run as they stand, and show figures."""

import os
import runpy

import jupytext
import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = (
    "1_the_papers_fit",
    "2_what_lifting_buys",
    "3_residual_models",
    "4_your_own_simulator",
    "5_tuning_through_the_loop",
    "6_three_dimensions",
)


def test_every_notebook_is_listed_here(repository):
    assert {p.stem for p in (repository / "notebooks").glob("*.py")} == set(NOTEBOOKS)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_executed_twin_is_of_this_source_and_shows_figures(repository, name):
    source = jupytext.read(repository / "notebooks" / f"{name}.py")
    file = repository / "docs" / "notebooks" / f"{name}.ipynb"
    twin = jupytext.read(file)
    cells = [[(cell.cell_type, cell.source) for cell in one.cells] for one in (source, twin)]
    assert cells[0] == cells[1], "run: make notebooks"
    outputs = [out for cell in twin.cells for out in cell.get("outputs", [])]
    assert any("image/png" in out.get("data", {}) for out in outputs)
    assert not any(out.output_type == "error" for out in outputs)
    assert file.stat().st_size < 300_000


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(repository, monkeypatch, name):
    monkeypatch.setattr(plt, "show", lambda: shown.append(plt.gcf()))
    monkeypatch.chdir(repository)
    plt.switch_backend("agg")
    shown = []
    runpy.run_path(os.fspath(repository / "notebooks" / f"{name}.py"))
    assert shown
    plt.close("all")
