import matplotlib.pyplot as plt
import pytest


@pytest.fixture
def drawn(monkeypatch):
    """Figures that were saved and closed, still open to be looked at."""
    figures = []
    close = plt.close
    monkeypatch.setattr(plt, "close", figures.append)
    yield figures
    for figure in figures:
        close(figure)
