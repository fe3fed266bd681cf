"""What the gradient benchmark counts, on costs whose gradient is known."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.bench import gradient

SPACE = SimpleNamespace(start={"a": np.array([0.5, -1.0]), "b": np.array(2.0)})


@pytest.fixture
def costs(monkeypatch):
    """Choose the cost of (variables, scenario); scenarios are 1, 2, 3 and so on."""
    monkeypatch.setattr(gradient, "scenarios_of", lambda config, n: jnp.arange(1.0, n + 1.0))

    def choose(cost):
        monkeypatch.setattr(gradient, "build_objective", lambda config, space: cost)

    return choose


def smooth(variables, scenario):
    return scenario * jnp.sum(jnp.sin(variables["a"])) + variables["b"] ** 2


def test_a_right_gradient_is_within_rounding_of_the_differences(costs):
    costs(smooth)
    entry, errors = gradient.checked(None, SPACE, 3, 8)
    assert entry["compared"] == len(errors) == 3 * 3  # parameters by scenarios
    assert entry["drowned"] == 0
    assert entry["rel_err_p90"] < 1e-8
    assert entry["finite_fraction"] == 1.0
    # By hand: scenario s has the gradient (s cos 0.5, s cos 1, 4).
    norms = [np.hypot(s * np.hypot(np.cos(0.5), np.cos(1.0)), 4.0) for s in range(1, 9)]
    assert entry["grad_norm_median"] == pytest.approx(np.median(norms))


def test_a_wrong_gradient_is_found_out(costs):
    @jax.custom_jvp
    def square(x):
        return x**2

    @square.defjvp
    def wrong(primals, tangents):
        return primals[0] ** 2, 2.2 * primals[0] * tangents[0]  # 10 % too much

    costs(lambda variables, scenario: scenario * square(variables["b"]))
    space = SimpleNamespace(start={"b": np.array(2.0)})
    entry, _ = gradient.checked(None, space, 3, 3)
    assert entry["rel_err_median"] == pytest.approx(0.1 / 1.1, rel=1e-4)


def test_what_is_not_finite_and_what_rounding_drowns_is_counted(costs):
    def cost(variables, scenario):
        return smooth(variables, scenario) * jnp.where(scenario > 6.0, jnp.nan, 1.0)

    costs(lambda variables, scenario: cost(variables, scenario) + 0.0 * variables["still"])
    space = SimpleNamespace(start={**SPACE.start, "still": np.array(1.0)})
    entry, _ = gradient.checked(None, space, 2, 8)
    assert entry["finite_fraction"] == 0.75
    assert entry["drowned"] == 2  # a parameter that does nothing, in both scenarios


def test_the_price_is_a_batch_s_time_with_and_without_its_gradient(costs, monkeypatch):
    results = {}

    def interleaved(calls, rounds):
        assert rounds == 3
        results.update({name: call(0) for name, call in calls.items()})
        return {"value": np.array([1.0, 2.0, 4.0]), "both": np.array([2.0, 6.0, 10.0])}

    monkeypatch.setattr(gradient, "interleaved", interleaved)
    costs(smooth)
    found = gradient.priced(None, SPACE, 4, 3)
    # What is timed is the mean over the batch, and its gradient: 4 by b in every scenario.
    value, slopes = results["both"]
    assert value == pytest.approx(float(results["value"]))
    assert value == pytest.approx(2.5 * np.sin([0.5, -1.0]).sum() + 4.0)
    assert slopes["b"] == pytest.approx(4.0)
    assert (found["value_s"], found["value_and_grad_s"]) == (2.0, 6.0)
    assert found["grad_over_value"] == 2.5  # of the rounds' ratios 2, 3 and 2.5
    program = SimpleNamespace(memory_analysis=lambda: SimpleNamespace(temp_size_in_bytes=3e6))
    assert gradient._temporary_memory(program) == 3.0


@pytest.mark.slow
def test_every_case_has_a_config_and_variables_that_it_tunes():
    for name in gradient._FILES:
        config, space = gradient.prepared(name)
        assert config.duration == gradient.SECONDS
        assert set(space.start) == set(gradient.KEYS[name])


def test_a_quick_run_reports_the_first_case(costs, monkeypatch, capsys, tmp_path):
    costs(smooth)
    monkeypatch.setattr(gradient, "prepared", lambda name: (None, SPACE))
    args = SimpleNamespace(quick=True, through_flight=False)
    found = gradient.run(tmp_path, args)
    assert list(found["cases"]) == ["trot"]
    assert found["scenarios"] == 16
    assert found["grad_rel_err_median"] < 1e-8
    assert found["grad_finite_fraction"] == 1.0
    text = (tmp_path / "table.md").read_text()
    assert text.splitlines()[2].startswith("| trot | 6 | ")
    assert "100% of 16" in text
    assert (tmp_path / "figure.png").stat().st_size > 5000
