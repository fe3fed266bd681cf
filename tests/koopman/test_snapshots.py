"""What is said of a user's own samples before they are fitted, and how to hand them over."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kjax.config import SrbConfig
from kjax.controllers.rigid_body import own_body
from kjax.koopman import dataset, edmd, observables
from kjax.koopman.dataset import DatasetSpec, Snapshots
from kjax.prediction import build, families
from kjax.prediction.kind import ModelChoice
from kjax.robots import go1
from kjax.types import Mode

DT = 2e-3  # s


def motion(rollouts=12, steps=40, seed=0, noise=0.0, dt=DT):
    """Random accelerations, held for a step each, integrated by hand: x+ = x + v dt + a dt^2/2."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(rollouts, steps, 3)) * [5.0, 8.0, 20.0]
    v0 = rng.normal(size=(rollouts, 1, 3)) * [0.5, 0.2, 1.0]
    v = np.concatenate([v0, v0 + dt * np.cumsum(a, axis=1)], axis=1)
    displacement = dt * v[:, :-1] + 0.5 * dt**2 * a
    x0 = rng.normal(size=(rollouts, 1, 3)) * [0.5, 0.05, 0.1] + [0.0, 0.3, 0.0]
    x = np.concatenate([x0, x0 + np.cumsum(displacement, axis=1)], axis=1)
    states = np.concatenate([x, v + noise * rng.normal(size=v.shape)], axis=2)
    inputs = rng.normal(size=(rollouts, steps, 4)) * 50.0
    return Snapshots(states, inputs, np.zeros((rollouts, 2, 2)))


def put(data, field, index, value):
    array = np.array(getattr(data, field))
    array[index] = value
    return data._replace(**{field: array})


def check(data, dictionary=None, dt=DT):
    return edmd.check_snapshots(data, dictionary or observables.paper(2), dt=dt)


def refusal(data, dictionary=None, dt=DT):
    with pytest.raises(ValueError) as caught:  # noqa: PT011, the text is the caller's
        check(data, dictionary, dt)
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])  # m/s, rad/s: none, a good and a bad sensor
def test_sound_samples_are_taken_without_a_remark(noise):
    assert check(motion(noise=noise)) == []
    single = jax.tree.map(np.float32, motion(noise=noise))
    assert check(single) == []


def test_a_standing_robot_with_noisy_sensors_is_taken():
    """Neither positions nor velocities say anything about the step; nor is anything wrong."""
    rng = np.random.default_rng(1)
    data = motion()
    states = rng.normal(size=data.states.shape) * [1e-3, 1e-3, 3e-3, 0.02, 0.02, 0.05]
    states[..., 1] += 0.27
    assert check(data._replace(states=states)) == []


def test_a_landing_is_no_spike():
    """A velocity that jumps once, by 2 m/s within a step, and stays."""
    data = motion()
    states = np.array(data.states)
    states[4, 20:, 4] += 2.0
    states[4, 20:, 1] += 2.0 * DT * np.arange(states.shape[1] - 20)
    assert check(data._replace(states=states)) == []


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        (lambda u: 0.0 * u, "F_x_front (0 N), F_z_front (0 N), F_x_rear (0 N), F_z_rear (0 N)"),
        (lambda u: 0.0 * u + 30.0, "F_x_front (30 N), F_z_front (30 N)"),
        (lambda u: u * [1.0, 1.0, 0.0, 0.0], "inputs F_x_rear (0 N), F_z_rear (0 N) do not vary"),
    ],
)
def test_inputs_that_do_not_vary_are_remarked(inputs, said):
    data = motion()
    (remark,) = check(data._replace(inputs=inputs(data.inputs)))
    assert said in remark
    assert "B" in remark


def test_regressors_that_follow_from_others_are_remarked_by_name():
    data = motion()
    tied = put(data, "inputs", (..., 3), 2.0 * data.inputs[..., 1] - data.inputs[..., 0])
    (remark,) = check(tied)
    assert "rank 14 of 15" in remark  # 1 + 6 states + 4 observables + 4 inputs
    assert "F_z_rear" in remark
    (remark,) = check(data, observables.paper(2, literal=True))
    assert "rank 15 of 19" in remark
    assert "-sin(theta) omega^1" in remark


def test_a_force_far_beyond_all_others_is_remarked():
    (remark,) = check(put(motion(), "inputs", (3, 7, 1), 1e6))
    assert "F_z_front" in remark
    assert "1e+06 N" in remark
    assert "rollout 3" in remark


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("step", [0, 17, 40])  # the first sample, one inside, the last
@pytest.mark.parametrize(("column", "name"), [(3, "v_x"), (4, "v_z"), (5, "omega")])
def test_a_single_spike_is_refused_with_its_place(column, name, step, noise):
    text = refusal(put(motion(noise=noise), "states", (5, step, column), 1000.0))
    assert f"{name} of rollout 5 is 1000" in text
    assert f"at step {step}" in text


def test_a_spike_of_a_position_is_a_jump():
    assert "rollout 2 jumps by" in refusal(put(motion(), "states", (2, 9, 1), 5.0))


@pytest.mark.parametrize("factor", [0.5, 2.0, 1000.0])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_wrong_step_is_found_and_the_right_one_named(factor, noise):
    text = refusal(motion(noise=noise), dt=DT * factor)
    assert f"dt is {DT * factor:g} s" in text
    named = float(text.split("seems to be ")[1].split(" s")[0])
    assert named == pytest.approx(DT, rel=0.05)  # three digits, and noise


def test_a_pitch_in_degrees_or_of_the_other_sign_is_no_wrong_step():
    data = motion()
    degrees = put(data, "states", (..., 2), np.degrees(data.states[..., 2]))
    assert "theta moves 57.3 times as far as omega says" in refusal(degrees)
    assert "theta moves -1 times as far as omega says" in refusal(
        put(data, "states", (..., 2), -data.states[..., 2])
    )


@pytest.mark.parametrize("dt", [0.0, -0.001, float("nan")])
def test_a_step_that_is_none_is_refused(dt):
    assert "dt must be a positive time" in refusal(motion(), dt=dt)


@pytest.mark.parametrize("field", ["states", "inputs", "feet"])
@pytest.mark.parametrize("kind", [complex, object, str])
def test_samples_that_are_no_real_numbers_are_refused(field, kind):
    data = motion()
    text = refusal(data._replace(**{field: getattr(data, field).astype(kind)}))
    assert text.startswith(f"{field}: got values of type")


def test_observables_that_are_not_finite_are_refused_by_name():
    mine = observables.custom_dictionary(
        lambda x: jnp.stack([jnp.sqrt(x[3]), x[5] ** 2]), names=["root", "sq"]
    )
    text = refusal(motion(), mine)
    assert "observable 'root' is not finite" in text
    assert "rollout" in text
    late = observables.custom_dictionary(lambda x: jnp.log(jnp.abs(x[:1] - 0.25)), names=["log"])
    states = motion().states.copy()
    states[7, 0, 0] = 0.25
    data = motion()._replace(states=states)
    text = refusal(data, late)
    assert "observable 'log' is not finite at step 0 of rollout 7" in text


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (Snapshots(np.zeros((0, 5, 6)), np.zeros((0, 4, 4)), np.zeros((0, 2, 2))), "no rollouts"),
        (Snapshots(np.zeros((3, 1, 6)), np.zeros((3, 0, 4)), np.zeros((3, 2, 2))), "1 state"),
        (motion(rollouts=1, steps=5), "5 snapshots are too few for 15 regressors"),
    ],
)
def test_no_samples_or_too_few_are_a_sentence_before_a_fit_and_in_it(data, said):
    assert said in refusal(data)
    for fit in (edmd.fit, edmd.fit_bilinear):
        with pytest.raises(ValueError, match=said.replace("15", r"\d+")):
            fit(observables.paper(2), data)


@pytest.mark.parametrize(("model", "columns"), [("linear", 19), ("bilinear", 75)])
def test_a_dataset_of_too_few_samples_is_refused_by_name(model, columns):
    few = DatasetSpec(rollouts=3, duration=0.005)
    body, key = edmd.srb_params(own_body(SrbConfig(), go1.PARAMS)), jax.random.key(0)
    choice = ModelChoice(model=model, dataset=few)
    fit = {
        "linear": lambda: edmd.fit_modes(body, key, dataset=few),
        "bilinear": lambda: build.build_prediction(
            body, choice, key, modes=tuple(Mode), heights=(0.27,) * len(Mode)
        ),
    }[model]
    with pytest.raises(ValueError, match=rf"dataset: rollouts 3 .* {columns} regressors"):
        fit()


def test_a_ridge_may_have_fewer_samples_than_regressors():
    model, _ = edmd.fit(observables.states_only(), motion(rollouts=1, steps=5), ridge=1e-6)
    assert np.isfinite(model.A).all()


def test_rollouts_shorter_than_the_delays_are_refused():
    delayed = observables.delays(observables.states_only(), 3)
    data = motion(steps=3)
    assert "4 states" in refusal(data, delayed)
    with pytest.raises(ValueError, match="4 states"):
        edmd.fit(delayed, data)


@pytest.mark.parametrize("family", [families.linear, families.bilinear])
def test_a_family_refuses_delay_coordinates(family):
    delayed = observables.delays(observables.states_only(), 2)
    with pytest.raises(ValueError, match=r"dictionary looks at 3 states .*takes one state"):
        family(delayed, DT)


# ---------------------------------------------------------------- episodes


def cut(data, lengths):
    """Episodes of these lengths, from rollouts."""
    return [
        (data.states[i, : n + 1], data.inputs[i, :n], data.feet[i]) for i, n in enumerate(lengths)
    ]


LENGTHS = (40, 3, 17, 1, 29)


def test_episodes_of_unequal_length_are_fitted_like_all_their_steps():
    data = motion(seed=3)
    episodes = cut(data, LENGTHS)
    snapshots = dataset.from_episodes(episodes)
    assert snapshots.inputs.shape == (sum(LENGTHS), 1, 4)
    plain = observables.states_only()
    model, _ = edmd.fit(plain, snapshots)
    Z = np.concatenate([np.c_[np.ones(len(u)), x[:-1], u] for x, u, _ in episodes])
    Y = np.concatenate([x[1:] for x, _, _ in episodes])
    K = np.linalg.lstsq(Z, Y, rcond=None)[0].T
    # Rounding 2e-16 times the condition of the unscaled regressor, about 1e4.
    np.testing.assert_allclose(model.A[1:], K[:, :7], atol=1e-10)
    np.testing.assert_allclose(model.B[1:], K[:, 7:], atol=1e-10)
    assert check(snapshots, plain) == []


def test_contact_points_may_change_from_step_to_step():
    data = motion(rollouts=2)
    rng = np.random.default_rng(0)
    feet = rng.normal(size=(40, 2, 2))
    episodes = [(data.states[0], data.inputs[0], feet), (data.states[1], data.inputs[1], feet[0])]
    snapshots = dataset.from_episodes(episodes)
    np.testing.assert_array_equal(snapshots.feet[:40], feet)
    np.testing.assert_array_equal(snapshots.feet[40:], np.broadcast_to(feet[0], (40, 2, 2)))


def test_delays_take_episodes_too_each_step_once():
    episodes = cut(motion(), (6, 2, 9))
    snapshots = dataset.from_episodes(episodes, window=3)
    assert snapshots.states.shape == (4 + 0 + 7, 4, 6)  # n - 2 steps have two states before them
    np.testing.assert_array_equal(snapshots.states[4], episodes[2][0][:4])
    delayed = observables.delays(observables.states_only(), 2)
    Z, _ = edmd.regressors(delayed, snapshots)
    assert Z.shape == (11, 19 + 4)
    np.testing.assert_array_equal(Z[4, 19:], episodes[2][1][2])  # the input of the present state


def test_a_spike_in_an_episode_is_found():
    data = put(motion(), "states", (2, 8, 3), 1000.0)
    assert "v_x of rollout" in refusal(dataset.from_episodes(cut(data, LENGTHS)))


@pytest.mark.parametrize(
    ("episodes", "said"),
    [
        ([], "episodes must hold at least one"),
        ([(np.zeros((5, 6)), np.zeros((5, 4)), np.zeros((2, 2)))], r"episodes\[0\].*one more"),
        ([(np.zeros((5, 7)), np.zeros((4, 4)), np.zeros((2, 2)))], r"episodes\[0\].*\(5, 7\)"),
        ([(np.zeros((5, 6)), np.zeros((4, 3)), np.zeros((2, 2)))], r"episodes\[0\].*\(4, 3\)"),
        ([(np.zeros((5, 6)), np.zeros((4, 4)), np.zeros((3, 2, 2)))], r"feet.*\(3, 2, 2\)"),
        ([(np.zeros((5, 6)), np.zeros((4, 4)))], r"episodes\[0\].*states, inputs and feet, got 2"),
        ([(np.zeros((1, 6)), np.zeros((0, 4)), np.zeros((2, 2)))], "no episode is longer than"),
    ],
)
def test_what_is_no_episode_is_named(episodes, said):
    with pytest.raises(ValueError, match=said):
        dataset.from_episodes(episodes)
