# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # Three dimensions: what is exactly linear, and what a better prediction buys
#
# In the plane seven observables made the rigid body bilinear. In three dimensions ten make its
# place, velocity and angular momentum exactly *linear*; only the attitude stays outside. Here EDMD
# finds that model, five that hold the attitude too are compared, and two of them walk.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

from kjax.dynamics import rotations, spatial_data, srb_spatial  # noqa: E402
from kjax.dynamics.srb_spatial import Contacts, SpatialBody  # noqa: E402
from kjax.koopman import momentum, so3  # noqa: E402
from kjax.mpc.response import PredictionTask, Targets  # noqa: E402
from kjax.mpc.rigid_models import PREDICTIONS  # noqa: E402
from kjax.robots import get_robot  # noqa: E402

DT, NODES, LEGS = 0.025, 8, (0, 3)  # s; a horizon of 0.2 s; the trot's diagonal pair stands
robot = get_robot("go1").params
body = SpatialBody(mass=jnp.asarray(float(robot.mass)), inertia=jnp.asarray(robot.inertia))
hips = spatial_data.footholds(robot)


def draw(seed, count, nodes, anywhere):
    """Random roll-outs of the rigid body."""
    return spatial_data.draw(
        body, hips, [seed], LEGS, count=count, nodes=nodes, dt=DT, anywhere=anywhere
    )


steps = draw(0, 4000, 1, anywhere=True)
test = draw(1, 100, NODES, anywhere=False)

# %% [markdown]
# ## Ten observables that close
#
# With the forces in the world frame and a point o that is fixed there, (1, p, v, H) with
# `H = L + m (p - o) x v` is linear: no product of state and force is left, whatever the attitude
# does. EDMD sees 400 steps of the *nonlinear* body, and finds the matrices that its equations give.

# %%
feet = jnp.asarray(hips[list(LEGS)] - [0.0, 0.0, spatial_data.HEIGHT])
about = jnp.zeros(3)


@jax.jit
@jax.vmap
def lifted(state, force):
    """Observables along the motion over feet that stay where they are."""
    contacts = Contacts(jnp.broadcast_to(feet, force.shape), force)
    states = srb_spatial.rollout(body, state, contacts, jnp.full(len(force), DT), substeps=4)
    return jax.vmap(lambda one: momentum.lift(body, one, about))(states)


def sample(data, count):
    """Lifted trajectories, and the forces of the standing feet."""
    force = data.force[:count, :, jnp.array(LEGS)]
    start = jax.tree.map(lambda a: a[:count, 0], data.states)
    return lifted(start, force), force.reshape(*force.shape[:2], -1)


z, u = sample(steps, 400)
found, report = jax.jit(momentum.fit)(z[:, 0], u[:, 0], z[:, 1])
known = jax.jit(momentum.exact_model)(body, feet, about, DT)
unseen, u = sample(test, 100)
predicted = jax.jit(jax.vmap(momentum.rollout, (None, 0, 0)))(found, unseen[:, 0], u)
error = float(jnp.abs(predicted - unseen).max())
print(f"rank {int(report.rank)} of {int(report.columns)} regressors")
print(f"A off by {float(jnp.abs(found.A - known.A).max()):.0e}, "
      f"B by {float(jnp.abs(found.B - known.B).max()):.0e}")  # fmt: skip
print(f"largest error of an observable in 100 roll-outs of {1e3 * DT * NODES:.0f} ms: {error:.0e}")
assert error < 1e-9

# %% [markdown]
# ## The attitude: five models behind one interface
#
# A plan needs the attitude as well. `PREDICTIONS` holds what `spatial.model` chooses from; each
# maps a `PredictionTask` to a nominal roll-out and its changes by the forces' changes. `edmd` and
# `bilinear` use 28 observables on SO(3), (1, p, v, R, omega, R [omega]), and what EDMD finds from
# 4,000 steps. The linear one has no place for the product of attitude and moment.
#
# Each predicts about the mean forces; the test's forces are 0.3 to 1.7 of their share.

# %%
fit = jax.jit(so3.fit_body, static_argnames=("dt", "bilinear"))
learned = {name: fit(steps, DT, bilinear=name == "bilinear") for name in ("edmd", "bilinear")}
share = np.zeros((4, 3))
share[list(LEGS), 2] = float(body.mass) * 9.81 / len(LEGS)
mean = jnp.broadcast_to(jnp.asarray(share), (NODES, 4, 3))
time = DT * jnp.arange(1, NODES + 1)


def attitude_errors(name):
    """Angles (N, K) between the attitude that a model predicts and the true one [rad]."""

    def one(states, feet, force):
        start = jax.tree.map(lambda a: a[0], states)
        heading = start.R[:2, 0] / jnp.linalg.norm(start.R[:2, 0])
        targets = Targets(
            R=jnp.broadcast_to(jnp.eye(3), (NODES, 3, 3)),
            p=start.p[None] + time[:, None] * start.v[None],
            omega=jnp.zeros((NODES, 3)),
            v=jnp.broadcast_to(start.v, (NODES, 3)),
            heading=jnp.broadcast_to(heading, (NODES, 2)),
            force=mean,
        )
        length, contacts = jnp.full(NODES, DT), jnp.broadcast_to(feet, (NODES, 4, 3))
        task = PredictionTask(body, start, length, contacts, mean, targets, learned.get(name))
        response = PREDICTIONS[name](task)

        def node(x, now):
            A, B, outputs, change = now
            x = A @ x + jnp.einsum("lnf,lf->n", B, change)
            return x, outputs @ x

        given = (response.A, response.B, response.outputs, force - mean)
        _, changes = jax.lax.scan(node, jnp.zeros(response.A.shape[-1]), given)
        R = jax.vmap(rotations.exp)(changes[:, :3]) @ response.states.R[1:]
        off = jax.vmap(rotations.log)(R @ jnp.swapaxes(states.R[1:], -1, -2))
        return jnp.linalg.norm(off, axis=-1)

    return jax.jit(jax.vmap(one))(test.states, test.feet, test.force)


rms = {}
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for name in ("momentum", "convex", "present", *learned):
    rms[name] = np.degrees(np.sqrt(np.mean(np.asarray(attitude_errors(name)) ** 2, axis=0)))
    ax.semilogy(1e3 * np.asarray(time), rms[name], "o-", ms=3, label=name)
ax.set(xlabel="time [ms]", ylabel="error of the attitude, RMS [deg]")
ax.set_title("The momentum stays nearest to the truth; of what EDMD fits the bilinear model")
ax.legend()
plt.show()
for name, value in rms.items():
    print(f"{name:9} {value[3]:5.2f} deg after 100 ms, {value[-1]:5.2f} after 200 ms")
assert rms["momentum"][-1] < rms["bilinear"][-1] < rms["edmd"][-1]

# %% [markdown]
# ## In closed loop
#
# A rigid body trots: diagonal pairs take turns every 0.2 s, feet are set below the hips, and every
# 25 ms a plan of eight nodes gives the forces of the next one. The plan is the unconstrained
# minimiser of a weighted sum of squared errors and forces, about the last plan's forces. It starts
# tilted by 0.2 rad and rolling at 1 rad/s, and shall go 0.8 m/s ahead while it turns at 2 rad/s.
# The reference of the place moves with the body, as kjax knows no place.

# %%
V_X, YAW_RATE, STANCE = 0.8, 2.0, 8  # m/s, rad/s, nodes
LEAD = 0.13  # s, of the velocity error in a foothold
WEIGHTS = jnp.array([12, 2, 100, 2.5, 2.5, 50, 0.003, 0.003, 0.03, 4, 1.5, 0.4])  # of the 12 errors
FORCE = 2e-5  # weight of a squared force [1/N^2]


def about_z(yaw):
    """Rotations (..., 3, 3)."""
    c, s, o = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    return np.stack([c, -s, o, s, c, o, o, o, o + 1.0], axis=-1).reshape(*np.shape(yaw), 3, 3)


def wanted(node):
    """Attitude, place, rates and velocity on the circle that is asked for, at the nodes' ends."""
    yaw = YAW_RATE * DT * node
    R, radius = about_z(yaw), V_X / YAW_RATE
    p = np.stack([radius * np.sin(yaw), radius * (1 - np.cos(yaw)), 0 * yaw], axis=-1)
    return Targets(
        R=R, p=np.add(p, [0.0, 0.0, spatial_data.HEIGHT]),
        omega=np.broadcast_to([0.0, 0.0, YAW_RATE], p.shape), v=V_X * R[..., 0],
        heading=R[..., :2, 0], force=None,
    )  # fmt: skip


def foothold(node, leg):
    """Below the hip in the middle of the stance that begins, outside on the curve: h a / g."""
    middle = wanted(np.array(node + STANCE / 2))
    outside = spatial_data.HEIGHT * V_X * YAW_RATE / 9.81
    return (middle.p + middle.R @ (hips[leg] - [0.0, outside, 0.0])) * [1.0, 1.0, 0.0]


def lag(state, node):
    """How far from the path the body is, and how its velocity moves the footholds [m]."""
    now = wanted(np.array(float(node)))
    flat = np.array([1.0, 1.0, 0.0])
    return np.multiply(state.p - now.p, flat), np.multiply(LEAD * (state.v - now.v), flat)


def build_plan(name):
    """Forces (K, 4, 3) of a plan about ``nominal``, and the state after its first node."""

    @jax.jit
    def plan(state, feet, nominal, targets):
        length, stands = jnp.full(NODES, DT), (targets.force[..., 2:] > 0) * 1.0
        task = PredictionTask(body, state, length, feet, nominal, targets, learned.get(name))
        response = PREDICTIONS[name](task)
        n = response.A.shape[-1]

        def node(M, now):
            A, B, outputs, k = now
            M = jnp.einsum("ij,jklf->iklf", A, M)
            M = M.at[:, k].add(jnp.moveaxis(B, 0, 1))
            return M, jnp.einsum("yi,iklf->yklf", outputs, M)

        first = jnp.zeros((n, NODES, 4, 3))
        given = (response.A, response.B * stands[:, :, None], response.outputs, jnp.arange(NODES))
        G = jax.lax.scan(node, first, given)[1].reshape(NODES * 12, -1)  # of all forces
        R, p, v = response.states.R[1:], response.states.p[1:], response.states.v[1:]
        off = jax.vmap(rotations.log)(R @ jnp.swapaxes(targets.R, -1, -2))
        errors = [off, p - targets.p, response.omega - targets.omega, v - targets.v]
        e = jnp.concatenate(errors, axis=-1).reshape(-1)
        Q = jnp.tile(WEIGHTS, NODES)[:, None]
        H = G.T @ (Q * G) + FORCE * jnp.eye(G.shape[1])
        g = G.T @ (Q[:, 0] * e) + FORCE * (nominal - targets.force).reshape(-1)
        force = nominal - jnp.linalg.solve(H, g).reshape(nominal.shape) * stands
        contacts = Contacts(feet[:1], force[:1])
        end = srb_spatial.rollout(body, state, contacts, length[:1], substeps=10)
        return jax.tree.map(lambda a: a[-1], end), force

    return plan


def walk(name, seconds=3.0):
    """States of a trot under the plans of a model."""
    plan = build_plan(name)
    R = np.asarray(jax.jit(rotations.exp)(jnp.array([0.2, 0.0, 0.0])))
    L = R @ np.asarray(robot.inertia) @ R.T @ [1.0, 0.0, YAW_RATE]
    begin = wanted(np.array(0.0))
    state = jax.tree.map(jnp.asarray, srb_spatial.BodyState(p=begin.p, R=R, v=begin.v, L=L))
    nominal, out = None, [state]
    placed = np.stack([foothold(0, leg) for leg in range(4)])
    for tick in range(round(seconds / DT)):
        nodes = tick + np.arange(NODES)
        pair = (nodes // STANCE) % 2  # which diagonal stands
        stands = np.stack([pair == 0, pair == 1, pair == 1, pair == 0], axis=-1)
        force = stands[..., None] * np.array([0.0, 0.0, float(body.mass) * 9.81 / 2])
        begins = nodes - nodes % STANCE
        place, lead = lag(state, tick)
        feet = np.stack([[foothold(one, leg) for leg in range(4)] for one in begins]) + place + lead
        if tick % STANCE == 0:
            placed = feet[0]
        feet[begins == begins[0]] = placed  # they stand already
        targets = wanted(nodes + 1.0)
        targets = targets._replace(force=force, p=targets.p + place)  # velocities are followed
        # The last plan, one node further; its end is new.
        if nominal is None:
            nominal = force
        else:
            nominal = np.concatenate([nominal[1:], force[-1:]]) * stands[..., None]
        state, nominal = plan(state, feet, nominal, targets)
        out.append(state)
    return jax.tree.map(lambda *a: np.stack(a), *out)


walks = {name: walk(name) for name in ("momentum", "convex")}

# %%
fig, (tilt, speed) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
asked = wanted(np.arange(len(walks["momentum"].p), dtype=float))
rms_late = {}
for name, run in walks.items():
    angle = np.degrees(np.arccos(np.clip(run.R[:, 2, 2], -1.0, 1.0)))
    error = np.linalg.norm(run.v - asked.v, axis=-1)
    rms_late[name] = np.sqrt(np.mean(error[round(1.5 / DT) :] ** 2))
    tilt.plot(DT * np.arange(len(angle)), angle, label=name)
    speed.plot(DT * np.arange(len(angle)), error, label=name)
    print(f"{name:9} tilt from 1.5 s on at most {angle[round(1.5 / DT) :].max():.1f} deg, error of "
          f"the velocity {rms_late[name]:.3f} m/s RMS")  # fmt: skip
tilt.set(xlabel="time [s]", ylabel="tilt of the trunk [deg]")
speed.set(xlabel="time [s]", ylabel="error of the velocity [m/s]")
tilt.legend()
assert max(rms_late.values()) < 0.05
fig.suptitle("A trot of 0.8 m/s on a curve of 2 rad/s, from a tilted start: both models hold it")
plt.show()

# %% [markdown]
# Both get up and walk alike: a plan is made again before the errors of its later nodes matter.
# That is one walk of a rigid body, with one set of weights and no limits of the forces. The whole
# robot in MuJoCo, with the weights of each model tuned on the same number of episodes, is
# `kjax study spatial_walks` (docs/three_dimensions.md); `spatial.model` chooses the model of any
# run.
