"""Learning for control, with stand-ins for training and loops: how the two are compared."""

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from kjax.studies import learn_control


@pytest.fixture
def trained(monkeypatch):
    """Stand in for what takes long: a model is a number, which scales costs and errors."""
    calls = []

    def train(args, data, extra):
        model = 1.0 if extra is None else 0.5
        calls.append(None if extra is None else float(extra(2.0)))
        loss = np.geomspace(1.0, model, args.updates)
        return jnp.asarray(model), SimpleNamespace(diverged=False, loss=loss)

    def costs_of(params, run):
        return lambda model, scenarios: model * (1.0 + scenarios)

    def verdict_of(args, path):
        calls.append(path and path.name)
        return {
            "runs": args.walks, "falls": 1, "cost_median": 0.3,
            "velocity_rmse_mps": {"median": 0.02, "worst": 0.03, "n": args.walks - 1},
        }  # fmt: skip

    def errors(model, data):
        return jnp.full((4, 100, 6), 0.1 * model)

    stand_ins = {
        "draw": lambda seed, rollouts: None,
        "train": train,
        "save": lambda path, model: path.write_text(str(model)),
        "short": lambda args, path: None,
        "resolve": lambda config: (None, None),
        "costs_of": costs_of,
        "prediction_errors": errors,
        "verdict_of": verdict_of,
    }
    for name, stand_in in stand_ins.items():
        monkeypatch.setattr(learn_control, name, stand_in)
    loop = SimpleNamespace(
        draw_scenarios=lambda config, seed, count: jnp.linspace(0.0, 1.0, count),
        build_loop=lambda config, **more: None,
    )
    monkeypatch.setattr(learn_control, "loop", loop)
    return calls


def test_both_models_are_judged_alike_and_their_costs_compared_in_pairs(
    trained, call, capsys, tmp_path
):
    words = ("--updates", 20, "--walks", 3, "--scenarios", 4, "--weight", 0.1, "--out", tmp_path)
    assert call(learn_control.main, *words) == 0
    assert {p.name for p in tmp_path.iterdir()} == {
        "metrics.json", "table.md", "figure.png", "prediction.npz", "control.npz"
    }  # fmt: skip
    # Trained without, then with the cost: 0.1 times the mean of 2 (1 + s), s from 0 to 1.
    assert trained[:2] == [None, pytest.approx(0.3)]
    assert trained[2:] == ["prediction.npz", "control.npz", None]
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["prediction"]["held_out_cost"] == pytest.approx(1.5)
    assert found["prediction and control"]["held_out_cost"] == pytest.approx(0.75)
    assert len(found["prediction"]["held_out_cost_each"]) == learn_control.HELD_OUT
    # In every pair half the cost: so is each draw of the bootstrap.
    ratio = [found[f"cost_ratio{end}"] for end in ("", "_low", "_high")]
    assert ratio == pytest.approx([0.5, 0.5, 0.5])
    # Two components of 0.1 m/s each.
    assert found["prediction"]["velocity_error_50ms_rms"] == pytest.approx(0.1 * np.sqrt(2.0))
    assert found["prediction"]["velocity_error_50ms_max"] == pytest.approx(0.1)
    text = (tmp_path / "table.md").read_text()
    assert "| prediction | 0.141 | 1.500 | 1 of 3 | 0.0200 (0.0300) | 0.300 |" in text
    assert "| own linear model | - | - | 1 of 3 |" in text
    assert "0.500 (0.500 to 0.500)" in text
    assert text in capsys.readouterr().out


@pytest.mark.parametrize("name", ["updates", "rate", "scenarios", "seconds", "weight", "walks"])
def test_an_option_that_is_not_positive_is_one_line(trained, call, capsys, name):
    assert call(learn_control.main, f"--{name}=0") == 2
    assert f"--{name}: got 0" in capsys.readouterr().err
    assert trained == []
