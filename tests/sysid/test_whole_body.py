"""Models from whole-body episodes, on episodes made here from a known residual."""

import json
import os
import runpy
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.prediction import families, features, storage
from kjax.sysid import open_loop, whole_body
from kjax.sysid.transitions import Episode, split, transitions
from kjax.types import MODE_ALPHA, Mode

DT, SOLE, PHASE = 5e-3, 0.02, 12  # s, m, ticks
PAIRS = np.array([[True, False, False, True], [False, True, True, False]])


def true_weights(rng):
    """A residual of a trot, about as large as the Go1's."""
    W = np.zeros((len(Mode), 6, 17))
    scale = np.r_[np.ones(5), np.full(4, 100.0), np.ones(4), np.full(4, 50.0)]
    W[Mode.TROT, 3:] = 1e-3 * rng.normal(size=(3, 17)) / scale
    return W


def stepper(body, W):
    """Compiled (x, u, ground) -> next state."""
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    params = families.ResidualModel(families.BodyModel(body, alpha), jnp.asarray(W[Mode.TROT]))
    family = families.residual(DT, features.affine, remembers=False)

    def step(x, u, ground):
        start = whole_body.start_at(x, ground)
        return family.step(params, start, family.lift(params, start), u)[1:]

    return jax.jit(step)


def record_episode(seed, body, W, *, phases=4, lost=()):
    """A trot of the planted body plus W phi; new feet come down beneath where it is then."""
    rng = np.random.default_rng(seed)
    ticks = PHASE * phases + 3  # the last phase is cut off
    stance = np.repeat(PAIRS[np.arange(phases + 1) % 2], PHASE, axis=0)[:ticks]
    x = np.zeros((ticks, 6))
    x[0] = [seed, 0.27, *0.1 * rng.normal(size=4)]
    feet = np.zeros((ticks, 4, 2))
    force = np.zeros((ticks, 4, 3))
    step = stepper(body, W)
    for t in range(ticks):
        touches = t % PHASE == 0
        offset = np.array([0.19, 0.19, -0.18, -0.18]) + 0.05 * rng.normal(size=4)
        fresh = np.stack([x[t, 0] + offset, np.full(4, SOLE) + 0.01 * rng.normal(size=4)], axis=1)
        feet[t] = np.where(stance[t, :, None] & (not touches), feet[t - 1], fresh)
        if touches and t > 0:  # feet that lift do so after the sample that ends their last tick
            feet[t] = np.where(stance[t, :, None], fresh, feet[t - 1])
        pair_force = np.array([0.0, 62.0]) + 20.0 * rng.normal(size=(2, 2))
        c, s = np.cos(x[t, 2]), np.sin(x[t, 2])
        # The body's model takes them in its axes.
        world = pair_force @ np.array([[c, -s], [s, c]]).T
        force[t, :, ::2] = np.where(stance[t, :, None], np.repeat(world, 2, axis=0), 0.0)
        front, rear = (feet[t, legs][stance[t, legs]][0] for legs in (slice(0, 2), slice(2, 4)))
        ground = np.stack([front, rear]) - [0.0, SOLE]
        if t + 1 < ticks:
            x[t + 1] = step(x[t], pair_force.reshape(4), ground)
    # A sensor shows the physics step before: at a change still the old feet.
    touch = np.where(stance[np.maximum(np.arange(ticks) - 1, 0)], 60.0, 0.0)
    for tick, leg in lost:
        touch[tick, leg] = 0.0
    return Episode(x, feet, force, stance, touch, np.zeros(ticks, bool))


@pytest.fixture(scope="module")
def weights():
    return true_weights(np.random.default_rng(0))


@pytest.fixture(scope="module")
def episodes(body, weights):
    return [record_episode(seed, body, weights) for seed in range(10)]


@pytest.fixture(scope="module")
def data(episodes):
    return transitions(episodes, dt=DT, sole=SOLE)


def test_a_known_residual_is_recovered_to_rounding(data, body, weights):
    fit = whole_body.fit(data, body, dt=DT)
    assert fit.rank[Mode.TROT] == fit.columns[Mode.TROT] == 17
    assert fit.rows.tolist() == [0, 0, 0, 10 * (4 * PHASE - 3), *[0] * 5]
    # states of order 10 in float64 over a condition of 1e3 or so
    np.testing.assert_allclose(fit.W, weights, atol=1e-10)
    assert fit.after[Mode.TROT].max() < 1e-13 < fit.before[Mode.TROT, 3:].min()


def test_sums_over_ticks_fit_the_same_and_stay_within_a_phase(data, body, weights):
    fit = whole_body.fit(data, body, dt=DT, steps=5)
    assert fit.rows[Mode.TROT] == 10 * (4 * (PHASE - 4) - 3)
    np.testing.assert_allclose(fit.W, weights, atol=1e-10)


def test_the_fit_is_what_the_residual_family_takes(data, body, weights):
    """A prediction within a stance is that of ``families.residual`` in the LMPC's own terms."""
    window = open_loop.windows(data, 6, inside=True)
    assert len(window.x) == 10 * (4 * (PHASE - 5) - 3)
    predicted = open_loop.predict(window, body, dt=DT, W=weights)
    np.testing.assert_allclose(predicted, window.x, atol=1e-11)
    family = families.residual(DT, features.affine, remembers=False)
    alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    params = families.ResidualModel(
        families.BodyModel(body, alpha), jnp.asarray(weights[Mode.TROT])
    )
    start = whole_body.start_at(jnp.asarray(window.x[3, 0]), jnp.asarray(window.ground[3]))
    states = families.rollout(family, params, start, jnp.asarray(window.u[3]))
    np.testing.assert_allclose(predicted[3], states, atol=1e-12)


def test_a_residual_that_remembers_is_the_same_prediction(data, body):
    """The LMPC's lifted state carries what the recording knows: the last force, turning waves."""
    window = open_loop.windows(data, 6, inside=True, stride=7)
    W = np.zeros((len(Mode), 6, 29))
    W[Mode.TROT, 3:] = 1e-3 * np.random.default_rng(4).normal(size=(3, 29))
    W[..., 5:9] /= 100.0
    W[..., 17:21] /= 100.0
    predicted = open_loop.predict(window, body, dt=DT, W=W, features=features.clock_history)
    family = families.residual(DT, features.clock_history)
    params = families.ResidualModel(
        families.BodyModel(body, jnp.asarray(MODE_ALPHA[Mode.TROT], float)),
        jnp.asarray(W[Mode.TROT]),
    )

    @jax.jit
    def rollout(x, ground, phase, u):
        whole = phase.elapsed[0] + phase.left[0]
        start = whole_body.start_at(x, ground)._replace(
            u_before=phase.u_before[0],
            stance_phase=jnp.pi * phase.elapsed[0] / whole,
            stance_phase_rate=jnp.pi / whole,
        )
        return families.rollout(family, params, start, u)

    for i in (0, 1, 5):
        phase = jax.tree.map(lambda a, i=i: jnp.asarray(a[i]), window.phase)
        own = rollout(window.x[i, 0], window.ground[i], phase, window.u[i])
        np.testing.assert_allclose(own, predicted[i], atol=1e-12)
        assert np.abs(predicted[i] - window.x[i]).max() > 1e-4  # the weights count


def test_without_weights_the_prediction_is_the_planted_body(data, body):
    window = open_loop.windows(data, 4, inside=True, stride=50)
    family, alpha = families.planted(DT), jnp.asarray(MODE_ALPHA[Mode.TROT], float)
    start = whole_body.start_at(jnp.asarray(window.x[0, 0]), jnp.asarray(window.ground[0]))
    states = families.rollout(
        family, families.BodyModel(body, alpha), start, jnp.asarray(window.u[0])
    )
    predicted = open_loop.predict(window, body, dt=DT)
    np.testing.assert_allclose(predicted[0], states, atol=1e-12)


def test_place_in_the_gait_and_forces_are_those_of_the_schedule(data, episodes):
    one = data.rows(data.episode == 3)
    assert len(one.x) == 4 * PHASE  # the phase that is cut off is left out
    assert (one.mode == Mode.TROT).all()
    assert (one.next_mode == Mode.TROT).all()
    np.testing.assert_allclose(one.elapsed, np.tile(DT * np.arange(PHASE), 4), atol=1e-12)
    np.testing.assert_allclose(one.elapsed + one.left, DT * PHASE, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(one.new), PHASE * np.arange(4))
    # all rows, but those in which the sensors still show the feet before
    np.testing.assert_array_equal(np.flatnonzero(~one.planted), PHASE * np.arange(1, 4))
    force = episodes[3].force[..., ::2]
    for tick, legs in ((0, [0, 3]), (PHASE, [1, 2])):
        c, s = np.cos(one.x[tick, 2]), np.sin(one.x[tick, 2])
        body = force[tick, legs] @ np.array([[c, -s], [s, c]])
        np.testing.assert_allclose(one.u[tick], body.reshape(4))
    np.testing.assert_allclose(one.u_before[PHASE + 1], one.u[PHASE])
    assert not one.u_before[PHASE].any()  # these legs were in the air
    np.testing.assert_allclose(one.x_next[:-1], one.x[1:])


def test_lost_early_and_slipping_contacts_are_marked(body, weights):
    # The flag of a stance leg is lost, seen at the end of tick 4.
    whole = record_episode(0, body, weights, lost=[(5, 0)])
    touch = np.array(whole.foot_force)
    touch[20, 3] = 50.0  # a leg in the air
    feet = np.array(whole.feet)
    feet[29:37, 3] += [0.01, 0.0]  # slips in tick 28, and stays there until it lifts
    touch[PHASE - 1, 1] = 50.0  # lands a tick early
    disturbed = np.arange(len(whole.x)) == 30
    seen = transitions(
        [whole._replace(feet=feet, foot_force=touch, disturbed=disturbed)], dt=DT, sole=SOLE
    )
    changes = {PHASE, 2 * PHASE, 3 * PHASE}  # where the sensors still show the feet before
    assert set(np.flatnonzero(~seen.held)) == {4, 5} | changes
    assert set(np.flatnonzero(~seen.clear)) == {10, 11, 19, 20} | changes
    assert np.flatnonzero(~seen.still).tolist() == [28]
    assert not seen.planted[[4, 5, 19, 20, 28, 30]].any()
    inside = open_loop.windows(seen, 3, inside=True)
    assert inside.disturbed.sum() == 3  # they are kept, and told
    begins = np.round(inside.phase.elapsed[:, 0] / DT).astype(int)
    assert begins[:5].tolist() == [0, 1, 6, 7, 1]  # of the first phase 0-3 and 6-9, then 13 on


def test_an_idle_end_gets_no_weight(body):
    """What a swinging foot does must not be learned as if it stood there."""
    rng = np.random.default_rng(0)
    ticks = 400
    front = np.tile([True, True, False, False], (ticks, 1))
    front[-1:] = True
    feet = rng.normal(size=(ticks, 4, 2))
    feet[:, :2] = [0.2, 0.0]
    episode = Episode(
        x=0.1 * rng.normal(size=(ticks, 6)),
        feet=feet,
        force=np.where(front[..., None], rng.normal(size=(ticks, 4, 3)), 7.0),
        stance=front,
        foot_force=60.0 * front,
        disturbed=np.zeros(ticks, bool),
    )
    seen = transitions([episode], dt=DT, sole=SOLE)
    assert not seen.u[:, 2:].any()
    fit = whole_body.fit(seen, body, dt=DT, features=features.history)
    #  1, theta, v, omega; then force, arm, moments and last force of the front end
    assert fit.columns[Mode.FRONT] == fit.rank[Mode.FRONT] == 5 + 2 + 2 + 2 + 2
    idle = [7, 8, 11, 12, 15, 16, 19, 20]
    assert not fit.W[Mode.FRONT][:, idle].any()


def test_the_split_keeps_episodes_whole(data):
    fit, out = split(data.episode, share=0.3)
    assert len(out) == 3
    assert sorted([*fit, *out]) == list(range(10))
    np.testing.assert_array_equal(out, split(data.episode, share=0.3)[1])
    with pytest.raises(ValueError, match="share must lie between 0 and 1"):
        split(data.episode, share=1.0)
    with pytest.raises(ValueError, match="leaves none to fit on"):
        split(np.array([4, 4]), share=0.5)


def test_a_schedule_carries_a_prediction_over_a_touchdown(data, body, weights):
    """Landing feet come down where feet do on average; with the feet kept it is far worse."""
    landing = open_loop.fit_landing(data)
    window = open_loop.windows(data, PHASE, inside=False)
    errors = {}
    for name, own in (("frozen", None), ("scheduled", landing)):
        states = open_loop.predict(window, body, dt=DT, W=weights, landing=own)
        errors[name] = open_loop.squared_errors(window, states)["omega"].mean(axis=0)
    whole = open_loop.windows(data, PHASE, inside=True)
    assert 0 < len(whole.x) < len(window.x)
    assert np.sqrt(errors["scheduled"][-1]) < 0.8 * np.sqrt(errors["frozen"][-1])


def test_the_force_gain_is_one_for_the_rigid_body_and_follows_the_residual(data, body):
    fit = whole_body.fit(data, body, dt=DT)
    exact = fit._replace(W=np.zeros_like(fit.W))
    gains = whole_body.force_gains(exact, data, body, dt=DT)
    np.testing.assert_allclose(gains[Mode.TROT], 1.0, atol=1e-9)
    assert np.isnan(gains[Mode.FRONT]).all()
    less = np.array(exact.W)
    less[Mode.TROT, 3, [5, 7]] = -0.15 * DT / float(body.mass)  # F_x of both ends
    gains = whole_body.force_gains(fit._replace(W=less), data, body, dt=DT)
    np.testing.assert_allclose(gains[Mode.TROT], [0.85, 1.0], atol=2e-3)  # cos of the pitch


def test_the_interval_of_a_ratio_holds_it_and_draws_whole_episodes():
    rng = np.random.default_rng(0)
    episode = np.repeat(np.arange(20), 30)
    size = np.repeat(rng.uniform(0.5, 2.0, 20), 30)[:, None]
    nominal = size * rng.chisquare(1, (600, 2))
    ratio, low, high = open_loop.rms_ratio(0.25 * nominal, nominal, episode)
    np.testing.assert_allclose([ratio, low, high], 0.5, atol=1e-12)
    model = 0.25 * size * rng.chisquare(1, (600, 2))
    ratio, low, high = open_loop.rms_ratio(model, nominal, episode)
    assert (low < ratio).all()
    assert (ratio < high).all()
    assert (low < 0.5).all()
    assert (high > 0.5).all()


def test_what_cannot_be_used_is_said(body, weights):
    one = record_episode(0, body, weights)
    still = one._replace(stance=np.ones_like(one.stance))
    with pytest.raises(ValueError, match="at least one whole phase"):
        transitions([still], dt=DT, sole=SOLE)


@pytest.mark.slow
def test_the_experiment_runs_and_records_once(repository, tmp_path, monkeypatch, capsys):
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(repository / ".cache" / "jax"),
    }
    done = subprocess.run(
        [sys.executable, "experiments/whole_body.py", "--quick", "--out", str(tmp_path)],
        cwd=repository,
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    assert "recording" in done.stdout
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "metrics.json", "table.md", "details.json", "figure.png",
        "residual_trot.npz", "residual_bound.npz",
        "residual_trot_clock_history.npz", "residual_bound_clock_history.npz",
        "weights_trot.npz", "weights_bound.npz", "cache",
    }  # fmt: skip
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    # Ten short episodes already: the limits of the whole study with some room.
    assert 0.0 < metrics["residual_velocity_ratio_50ms"] < 0.35
    assert 0.0 < metrics["residual_pitch_rate_ratio_50ms"] < 0.85
    trot, bound = (
        storage.load(tmp_path / f"residual_{gait}.npz", "residual") for gait in ("trot", "bound")
    )
    assert trot.params.shape == (len(Mode), 6, 17)
    assert trot.params[Mode.TROT].any()
    assert not trot.params[Mode.REAR].any()
    assert bound.params[Mode.FRONT].any()
    # One tick's error of the velocity after 5 ms: millimetres per second.
    assert (trot.spread[Mode.TROT, 3:5] > 1e-4).all()
    assert (trot.spread[Mode.TROT, 3:5] < 2e-2).all()
    # What lies there is taken, and only that.
    monkeypatch.syspath_prepend(repository / "experiments")
    script = runpy.run_path(str(repository / "experiments" / "whole_body.py"))
    options = SimpleNamespace(robots=10, duration=3.0, force=15.0)
    episodes = script["record"]("trot", options, tmp_path)
    assert len(episodes) == 10
    assert capsys.readouterr().out == "trot: 10 episodes of 3 s are there\n"
