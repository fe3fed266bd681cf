# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # Tuning a bound from bad weights, by gradients through the closed loop
#
# `kjax.tuning` closes the loop of the controller's `plan` (phase clock, footholds, lift, QP) and
# a rigid body, 200 QPs per second; the episode is a differentiable function of the parameters.
# Here every weight of a bound is off by a factor of ten, up or down, and Adam finds its way back.

# %%
import jax
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

from kjax import RunConfig, load_config  # noqa: E402
from kjax.robots import get_robot  # noqa: E402
from kjax.tuning import loop, optimise, space  # noqa: E402

# Forces in a box, as in the paper: friction and torque rows make the gradient's compilation longer.
box = {"lmpc.friction": float("inf"), "lmpc.torque_fraction": float("inf")}
config = load_config(RunConfig, "configs/bound_velocity_short.toml", {"duration": 1.2, **box})
keys = ["gaits.bound.Q", "gaits.bound.R", "gaits.bound.foothold_gain"]
search_space = space.build_space(config, keys)
print(
    {key: np.round(value, 3) for key, value in search_space.overrides(search_space.start).items()}
)

# %% [markdown]
# Variables are logarithms of weights, so that a step of 0.1 is ten per cent of each. A scenario is
# a command, a start, sensor noise and an error of mass and inertia.

# %%
rng = np.random.default_rng(1)
bad = search_space.inside(
    {
        key: one + np.log(10.0) * rng.choice([-1.0, 1.0], one.shape)
        for key, one in search_space.start.items()
    }
)
train, held_out = (loop.draw_scenarios(config, seed, 6, speeds=(0.0, 0.8)) for seed in (100, 200))

# %% [markdown]
# ## A derivative that is right and useless
#
# The bad bound is chaotic: two weights that differ by a hair leave its saturated stances in
# different places. Its true derivative grows with the length of the run. `memory` lets what goes
# back through the body's state fade in 0.1 s: no longer the derivative of the cost, but a direction
# in which every tick does better by what led to it.


# %%
def slopes_along(direction, memory):
    """Derivative of each scenario's cost along a direction of the variables, forward mode."""
    objective = optimise.build_objective(config, search_space, memory=memory)

    def along(scenario):
        return jax.jvp(lambda z: objective(z, scenario), (bad,), (direction,))[1]

    return jax.jit(jax.vmap(along))(train)


damping = jax.tree.map(np.zeros_like, search_space.start)
damping["gaits.bound.Q"][3:] = 1.0  # the three velocities' weights together
slopes = slopes_along(damping, float("inf"))
print("bad weights, true derivatives:", [f"{slope:.0e}" for slope in slopes])

# %%
MEMORY = 0.1  # s
objective = optimise.build_objective(config, search_space, memory=MEMORY)
result = optimise.descend(
    objective, search_space, train, held_out, start=bad, updates=30, rate=0.2, patience=30
)
own = float(jax.jit(jax.vmap(objective, (None, 0)))(search_space.start, held_out).mean())
print(f"held-out cost: {result.held_out[0]:.1f} -> {result.best_cost:.1f}; tuned by hand {own:.1f}")
print(search_space.overrides(result.best))

# %% [markdown]
# ## The loss curve, and the two gaits side by side

# %%
run = jax.jit(loop.build_loop(config))
scenario = jax.tree.map(lambda a: a[1], held_out)
untuned, tuned = (
    jax.device_get(run(search_space.params(variables), scenario))
    for variables in (bad, result.best)
)
print(
    "cost of this scenario:",
    *(f"{float(loop.cost(get_robot().params, t)):.1f}" for t in (untuned, tuned)),
)
fig, axes = plt.subplots(2, 3, figsize=(11, 5), layout="constrained")
curve, off = axes[:, 0]
curve.plot(result.cost, lw=0.8, label="training scenarios")
curve.plot(result.checks, result.held_out, "o-", ms=3, label="held out")
curve.axhline(own, color="k", ls="--", lw=0.8, label="tuned by hand")
curve.set(xlabel="update", ylabel="cost", yscale="log")
curve.legend(fontsize=7)
off.axis("off")
t = np.arange(len(untuned.x)) * config.lmpc.control_dt
for column, (name, trace) in zip(axes.T[1:], (("before", untuned), ("after", tuned)), strict=True):
    alive = np.where(trace.alive, 1.0, np.nan)
    column[0].plot(t, trace.wanted[:, 0], "k--", lw=0.8)
    column[0].plot(t, trace.x[:, 3] * alive, lw=1.0)
    column[0].set(title=name, ylabel="v_x [m/s]", ylim=(-0.6, 1.6))
    column[1].plot(t, np.degrees(trace.x[:, 2]) * alive, lw=1.0)
    column[1].set(xlabel="time [s]", ylabel="pitch [deg]", ylim=(-60, 60))
for ax in axes.flat:
    ax.grid(alpha=0.3)
plt.show()

# %% [markdown]
# What the rigid body likes need not be what the robot likes: here friction takes what a foot cannot
# hold, and the foot stays; in MuJoCo it flies away. With `lmpc.friction` as rows of the QP neither
# happens, and what is tuned here works there. `kjax tune` ends with the verdict in
# MuJoCo, beside CMA-ES in MuJoCo itself for the same time.
