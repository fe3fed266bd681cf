# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # Your own simulator, your own robot
#
# Plain MuJoCo and a robot that kjax has never seen: 20 kg, longer legs, joints in another order and
# with names of its own. Nothing here comes from `kjax.sim`; with a real robot or another simulator
# it is the same three steps: describe the robot, hand over observations, send torques.

# %%
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from kjax import ControlLoop, Observation, RunConfig, load_config, resolve
from kjax.types import RobotParams

# %% [markdown]
# ## A robot
#
# Legs are called lf, rf, lh, rh here, in this order, and their joints haa, hfe, kfe.

# %%
TRUNK, HIP, THIGH, CALF = 10.0, 0.7, 1.4, 0.4  # kg
LENGTH, RADIUS, OFFSET = 0.24, 0.025, 0.09  # m: thigh and calf each; foot; hip to thigh
HIP_X, HIP_Y = 0.24, 0.06
LIMIT = np.array([40.0, 40.0, 60.0])  # N m
SIDES = {"lf": (1, 1), "rf": (1, -1), "lh": (-1, 1), "rh": (-1, -1)}


def leg(name, front, left):
    """A leg of three links; masses in their middles."""
    return f"""
    <body name="{name}_hip" pos="{HIP_X * front} {HIP_Y * left} 0">
      <joint name="{name}_haa" axis="1 0 0"/>
      <inertial pos="0 0 0" mass="{HIP}" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="{name}_thigh" pos="0 {OFFSET * left} 0">
        <joint name="{name}_hfe" axis="0 1 0"/>
        <inertial pos="0 0 -0.06" mass="{THIGH}" diaginertia="7e-3 7e-3 1e-3"/>
        <geom class="shin" fromto="0 0 0 0 0 {-LENGTH}" size="0.02"/>
        <body name="{name}_calf" pos="0 0 {-LENGTH}">
          <joint name="{name}_kfe" axis="0 1 0"/>
          <inertial pos="0 0 -0.12" mass="{CALF}" diaginertia="2e-3 2e-3 1e-4"/>
          <geom class="shin" fromto="0 0 0 0 0 {-LENGTH}" size="0.012"/>
          <geom type="sphere" size="{RADIUS}" pos="0 0 {-LENGTH}" friction="0.8"/>
          <site name="{name}_sole" pos="0 0 {-LENGTH}" size="{1.2 * RADIUS}"/>
        </body>
      </body>
    </body>"""


JOINTS = [f"{name}_{joint}" for name in SIDES for joint in ("haa", "hfe", "kfe")]
XML = f"""
<mujoco>
  <option timestep="0.001"/>
  <default>
    <joint damping="0.1" armature="0.01"/>
    <default class="shin"><geom type="capsule" contype="0" conaffinity="0"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="0 0 1" friction="0.8"/>
    <light pos="0 0 3"/>
    <body name="torso" pos="0 0 0.5">
      <freejoint/>
      <inertial pos="0 0 0" mass="{TRUNK}" diaginertia="0.06 0.25 0.28"/>
      <geom type="box" size="0.27 0.1 0.06"/>
      {"".join(leg(name, *side) for name, side in SIDES.items())}
    </body>
  </worldbody>
  <actuator>{"".join(f'<motor name="{j}" joint="{j}"/>' for j in JOINTS)}</actuator>
  <sensor>{"".join(f'<touch name="{n}" site="{n}_sole"/>' for n in SIDES)}</sensor>
</mujoco>"""
model = mujoco.MjModel.from_xml_string(XML)
data = mujoco.MjData(model)
print(f"{model.body_mass.sum():.1f} kg, {model.nu} motors")

# %% [markdown]
# ## What the controller must know of it
#
# Numbers only, with legs in the order FR, FL, RR, RL. The pitch inertia is that of the whole robot,
# standing; MuJoCo knows where every link is.

# %%
HEIGHT = 0.33  # m, of the centre of mass in the nominal stance
ORDER = ["rf", "lf", "rh", "lh"]
FORE = np.array([SIDES[name][0] for name in ORDER])
LEFT = np.array([SIDES[name][1] for name in ORDER])
joint_at = np.array(
    [[model.joint(f"{n}_{j}").qposadr[0] for j in ("haa", "hfe", "kfe")] for n in ORDER]
)
motor_at = np.array([[model.actuator(f"{n}_{j}").id for j in ("haa", "hfe", "kfe")] for n in ORDER])
touch_at = np.array([model.sensor(name).adr[0] for name in ORDER])


def stand(height):
    """Put the robot on its feet, feet below the hips."""
    mujoco.mj_resetData(model, data)
    data.qpos[2] = height
    bend = np.arccos((height - RADIUS) / (2.0 * LENGTH))
    data.qpos[joint_at] = [0.0, bend, -2.0 * bend]
    mujoco.mj_forward(model, data)


def inertia():
    """Of all links about the common centre of mass, trunk axes (3, 3) [kg m^2]."""
    arms = data.xipos - data.subtree_com[0]
    axes = data.ximat.reshape(-1, 3, 3)
    own = np.einsum("bij,bj,bkj->ik", axes, model.body_inertia, axes)
    square = (model.body_mass * (arms**2).sum(axis=1)).sum() * np.eye(3)
    return own + square - np.einsum("b,bi,bj->ij", model.body_mass, arms, arms)


stand(HEIGHT)
params = RobotParams(
    mass=np.float64(model.body_mass.sum()),
    inertia=inertia(),
    trunk_mass=np.float64(TRUNK),
    trunk_com=np.zeros(3),
    link_mass=np.array([HIP, THIGH, CALF]),
    link_com=np.tile([[0.0, 0.0, 0.0], [0.0, 0.0, -0.06], [0.0, 0.0, -0.12]], (4, 1, 1)),
    hip_pos=np.stack([HIP_X * FORE, HIP_Y * LEFT, np.zeros(4)], axis=-1),
    abduction_offset=OFFSET * LEFT,
    thigh_length=np.float64(LENGTH),
    calf_length=np.float64(LENGTH),
    foot_radius=np.float64(RADIUS),
    torque_limit=LIMIT,
    joint_range=np.array([[-0.8, 0.8], [-0.6, 3.0], [-2.7, -0.5]]),
    link_inertia=np.array([7e-3, 2e-3]),
    stand_height=np.float64(HEIGHT),
)

# %% [markdown]
# ## The loop
#
# `RunConfig()` is a trot of a free trunk; weights, bounds, gains and heights scale with weight and
# leg length. `ControlLoop` compiles when it is made.

# %%
config = load_config(RunConfig, None, {"command.times": [0.0, 0.5], "command.v_x": [0.0, 0.4]})
loop = ControlLoop(*resolve(config, params))


def read_robot():
    """What kjax asks for, from this simulator's own state."""
    return Observation(
        base_pos=data.body("torso").xpos.copy(),
        base_quat=data.body("torso").xquat.copy(),
        base_vel=data.qvel[:3].copy(),
        base_ang_vel=data.qvel[3:6].copy(),
        joint_pos=data.qpos[joint_at],
        joint_vel=data.qvel[joint_at - 1],  # a free joint has 7 coordinates and 6 velocities
        contact=data.sensordata[touch_at] > 5.0,
    )


def walk(seconds, begin=0.0):
    """Speed [m/s] and height [m] of the trunk over time."""
    log = []
    for step in range(round(1000 * seconds)):
        joints = loop.step(read_robot(), time=begin + 0.001 * step)
        data.ctrl[motor_at] = joints.torque
        mujoco.mj_step(model, data)
        log.append((data.qvel[0], data.qpos[2]))
    return np.array(log)


first = walk(3.0)

# %% [markdown]
# Another command takes effect at the next plan; nothing compiles again.

# %%
loop.command(v_x=0.7)
log = np.concatenate([first, walk(3.0, begin=3.0)])

fig, (speed, height) = plt.subplots(2, 1, figsize=(7, 4), sharex=True, layout="constrained")
time = 0.001 * np.arange(len(log))
speed.plot(time, log[:, 0], lw=0.8)
speed.step([0.0, 0.5, 3.0, 6.0], [0.0, 0.4, 0.7, 0.7], "k--", where="post", label="command")
speed.set(ylabel="v_x [m/s]", title="A 20 kg robot trots under a controller made for the Go1")
speed.legend()
height.plot(time, log[:, 1])
height.set(xlabel="time [s]", ylabel="trunk height [m]", ylim=(0.2, 0.4))
plt.show()

# %%
reached = [log[2500:3000, 0].mean(), log[5500:, 0].mean()]
print(f"mean speed {reached[0]:.2f} and {reached[1]:.2f} m/s, lowest {log[:, 1].min():.2f} m")
assert abs(reached[0] - 0.4) < 0.05
assert abs(reached[1] - 0.7) < 0.07
assert log[:, 1].min() > 0.26
