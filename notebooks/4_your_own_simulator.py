# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # Calling the controller from your own code
#
# The controller is four pure functions over plain data. It needs jax and numpy, no simulator. Here
# *your simulator* is twenty lines of MuJoCo; a robot looks the same from the controller's side.

# %%
import jax
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from kjax import RunConfig, load_config
from kjax.controllers.controller import build_controller
from kjax.controllers.params import condense, with_params
from kjax.controllers.resolve import resolve
from kjax.robots import get_robot
from kjax.sim.observe import build_observe, find_addresses
from kjax.sim.resolve import build_scene, start_state

config = load_config(RunConfig, None, {"command.times": [0.0, 0.5], "command.v_x": [0.0, 0.4]})

# %% [markdown]
# ## The controller
#
# `resolve` fits the Koopman models, `condense` builds the LMPC's tables: a second or two, once.

# %%
spec, params = resolve(config)
controller, tables = build_controller(spec), condense(spec, params)
plan, act = jax.jit(controller.plan), jax.jit(controller.act)

# %% [markdown]
# ## Your simulator
#
# It hands over an `Observation` (trunk pose and velocity, joints, foot contacts) and takes torques
# (4, 3) in the order FR, FL, RR, RL.

# %%
robot = get_robot(config.robot)
model = build_scene(config)
observe, at = build_observe(robot, model, 5.0), find_addresses(robot, model)
actuator = at.actuator.reshape(-1)
data = mujoco.MjData(model)
data.qpos[:], data.qvel[:] = start_state(config, model)
mujoco.mj_forward(model, data)


def closed_loop(tables, seconds):
    """Speed over time [m/s], sampled every 5 ms."""
    state = controller.init(tables, observe(data.qpos, data.qvel, data.sensordata))
    speed = []
    for step in range(round(seconds / config.sim.sim_dt)):
        seen = observe(data.qpos, data.qvel, data.sensordata)
        if step % 5 == 0:
            state, info = plan(tables, state, seen)
            speed.append(float(info.x[3]))
        state, joints = act(tables, state, seen)
        data.ctrl[actuator] = np.asarray(joints.torque).reshape(-1)
        mujoco.mj_step(model, data)
    return np.array(speed)


speed = closed_loop(tables, 3.0)

# %% [markdown]
# ## Parameters are data
#
# Another command: replace a leaf. Another weight: replace it, then `condense` again. Nothing
# compiles again.

# %%
command = params.command
slower = command._replace(values=0.5 * command.values)
speed = np.concatenate([speed, closed_loop(with_params(tables, command=slower), 3.0)])
plt.figure(figsize=(7, 3), layout="constrained")
plt.plot(0.005 * np.arange(len(speed)), speed)
plt.xlabel("time [s]")
plt.ylabel("v_x [m/s]")
plt.show()
assert plan._cache_size() == 1
print(f"mean speed of the last half second: {speed[-100:].mean():.2f} m/s")
assert abs(speed[-100:].mean() - 0.2) < 0.05
