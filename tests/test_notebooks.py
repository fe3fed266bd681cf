"""The notebooks run as they stand, and show figures."""

import os
import runpy

import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = (
    "1_the_papers_fit",
    "2_what_lifting_buys",
    "3_residual_models",
    "4_your_own_simulator",
    "5_tuning_through_the_loop",
)

pytestmark = pytest.mark.slow


def test_every_notebook_is_listed_here(repository):
    assert {p.stem for p in (repository / "notebooks").glob("*.py")} == set(NOTEBOOKS)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(repository, monkeypatch, name):
    monkeypatch.setattr(plt, "show", lambda: shown.append(plt.gcf()))
    monkeypatch.chdir(repository)
    plt.switch_backend("agg")
    shown = []
    runpy.run_path(os.fspath(repository / "notebooks" / f"{name}.py"))
    assert shown
    plt.close("all")
