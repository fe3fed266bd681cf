# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # Residual models: what no rigid body holds
#
# The robot is not a rigid body: legs have mass, contacts give, and the force that arrives is about
# nine tenths of the one that was planned. A residual on the rigid body learns that from the robot's
# own closed-loop episodes. `experiments/whole_body.py` is the whole study; this is its core.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

from kjax import RunConfig, load_config  # noqa: E402
from kjax.config import SrbConfig  # noqa: E402
from kjax.controllers.rigid_body import own_body  # noqa: E402
from kjax.prediction.features import affine, clock_history  # noqa: E402
from kjax.robots import get_robot  # noqa: E402
from kjax.sim.engines.mujoco_batch import BatchEngine  # noqa: E402
from kjax.sim.resolve import batch_spec, resolve_episodes  # noqa: E402
from kjax.sysid import open_loop, whole_body  # noqa: E402
from kjax.sysid.transitions import Episode, split, transitions  # noqa: E402

DT, ROBOTS = 0.005, 12

# %% [markdown]
# ## Episodes, with random forces
#
# In closed loop a force answers an error. A fit on such data takes the answer for the cause, so the
# planned forces are moved at random (`noise.force`, 15 N).

# %%
configs = [
    load_config(
        RunConfig,
        "configs/trot_velocity_long.toml",
        {
            "seed": seed,
            "duration": 3.0,
            "sim.contacts": "feet",
            "noise.force": 15.0,
            "lmpc.command_slew": 1.0,
            "command.times": [0.0, 1.0],
            "command.v_x": [0.0, float(np.linspace(-0.1, 0.5, ROBOTS)[seed])],
        },
    )
    for seed in range(ROBOTS)
]
recording = BatchEngine(batch_spec(configs[0]), torques="held").run(resolve_episodes(configs))
print(f"{ROBOTS} episodes of 3 s, {int(recording.fell.sum())} falls, {recording.wall_time:.0f} s")
log = recording.log
episodes = [
    Episode(
        x=log.x[:count, robot],
        feet=log.feet[:count, robot],
        force=log.force[:count, robot],
        stance=log.stance[:count, robot],
        foot_force=log.foot_force[:count, robot],
        disturbed=np.zeros(count, bool),
    )
    for robot, count in enumerate(recording.ticks)
]

# %% [markdown]
# ## Fit on some episodes, test on others
#
# Rows of one episode are alike, so whole episodes are held out. Only rows count in which the
# scheduled feet, and no others, touch the ground.

# %%
data = transitions(episodes, dt=DT, sole=float(get_robot().params.foot_radius))
train, test = split(np.arange(ROBOTS), share=0.33)
fitted, held = (data.rows(np.isin(data.episode, own)) for own in (train, test))
body = own_body(SrbConfig(), get_robot().params)._replace(feet=np.zeros((2, 2)))
models = {"affine": affine, "with clock and last force": clock_history}
fits = {
    name: whole_body.fit(fitted, body, dt=DT, features=features, steps=5)
    for name, features in models.items()
}
gains = whole_body.force_gains(fits["affine"], fitted, body, dt=DT, features=affine)
print("part of the planned force (F_x, F_z) that arrives in a trot:", np.round(gains[3], 2))

# %% [markdown]
# ## Open-loop error inside a stance

# %%
views = open_loop.windows(held, 10, inside=True)
errors = {"rigid body, feet planted": open_loop.predict(views, body, dt=DT)}
for name, features in models.items():
    errors[f"+ residual, {name}"] = open_loop.predict(
        views, body, dt=DT, W=fits[name].W, features=features
    )
fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
at_end = {}
for name, predicted in errors.items():
    squared = open_loop.squared_errors(views, predicted)
    for ax, key in zip(axes, ("velocity", "omega"), strict=True):
        rms = np.sqrt(squared[key].mean(axis=0))
        at_end[name, key] = rms[-1]
        ax.plot(1e3 * DT * np.arange(1, len(rms) + 1), rms, "o-", ms=3, label=name)
axes[0].set(xlabel="time [ms]", ylabel="rms error of the velocity [m/s]", ylim=0)
axes[1].set(xlabel="time [ms]", ylabel="rms error of the pitch rate [rad/s]", ylim=0)
axes[0].legend(fontsize=8)
plt.show()
best, base = "+ residual, with clock and last force", "rigid body, feet planted"
for key in ("velocity", "omega"):
    print(f"{key}: {at_end[best, key] / at_end[base, key]:.2f} of the rigid body's error at 50 ms")
    assert at_end[best, key] < 0.7 * at_end[base, key]
