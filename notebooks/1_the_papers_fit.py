# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # The paper's fit, and what ±1e-4 means
#
# The paper fits one linear model per contact mode in a lifted state: the constant, the state
# `[p_x, p_z, theta, v_x, v_z, omega]`, and the entries of `R(theta) omega^k`. It reports errors of
# ±1e-4 after 50 ms. Of what statistic, and on which ranges? Its text does not say. Let us fit and
# see.
#
# Run it as a script, in an editor that knows `# %%` cells, or as a notebook
# (`jupytext --to notebook`).

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

from kjax.config import SrbConfig  # noqa: E402
from kjax.controllers.rigid_body import own_body  # noqa: E402
from kjax.koopman import edmd, observables  # noqa: E402
from kjax.koopman.dataset import DatasetSpec, sample, sample_ranges, shrink  # noqa: E402
from kjax.prediction import evaluation, families  # noqa: E402
from kjax.robots import get_robot  # noqa: E402
from kjax.types import MODE_ALPHA, STATE_NAMES, Mode  # noqa: E402

DT = 1e-3
body = own_body(SrbConfig(), get_robot().params)
alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
ranges = sample_ranges(DatasetSpec())

# %% [markdown]
# ## Data, dictionary, fit
#
# 100 rollouts of 100 steps of 1 ms under random forces. `check_snapshots` looks at data before it
# is fitted; with your own data it is the first thing to call.

# %%
draw = jax.jit(
    lambda key, scale: sample(
        key, body, alpha, shrink(ranges, scale), rollouts=100, steps=100, dt=DT
    )
)
data = draw(jax.random.key(1), 1.0)
dictionary = observables.paper(4)
print(edmd.check_snapshots(data, dictionary, dt=DT) or "nothing to remark")
fit = jax.jit(lambda data: edmd.fit(dictionary, data))
model, report = fit(data)
print(f"rank {report.rank} of {report.columns}, condition {report.condition:.0f}")
literal = observables.paper(4, literal=True)
_, repeated = jax.jit(lambda data: edmd.fit(literal, data))(data)
print(f"letter by letter: rank {repeated.rank} of {repeated.columns}: columns repeat")

# %% [markdown]
# ## The error against time
#
# 50 random starts under 50 random force profiles, lifted once and predicted open loop.


# %%
def errors_of(model, scale):
    """Errors (states, profiles, steps, 6) on ranges of that size."""
    here = shrink(ranges, scale)
    starts = sample(jax.random.key(2), body, alpha, here, rollouts=50, steps=1, dt=DT).states[:, 0]
    forces = sample(jax.random.key(3), body, alpha, here, rollouts=50, steps=50, dt=DT).inputs
    family = families.linear(dictionary, DT)
    return evaluation.model_errors(family, model, "body", body, alpha, starts, forces)


judge = jax.jit(lambda model, scale: evaluation.summarise(errors_of(model, scale)))
statistics = judge(model, 1.0)
fig, axes = plt.subplots(1, 4, figsize=(13, 3), layout="constrained")
for ax, name in zip(axes, ("mean", "variance", "std", "max"), strict=True):
    for i, state in enumerate(STATE_NAMES):
        ax.semilogy(np.arange(1, 51), np.abs(getattr(statistics, name)[:, i]) + 1e-17, label=state)
    ax.axhline(1e-4, color="0.5", ls=":")
    ax.set(title=name, xlabel="time [ms]", ylim=(1e-12, 1))
axes[0].legend(fontsize=7)
plt.show()

# %% [markdown]
# ## On which ranges is it below 1e-4?
#
# The same, fitted and tested on smaller ranges: the variance passes on half of them, the largest
# error only on tiny ones. A variance of 1e-4 of a velocity is a standard deviation of 1 cm/s.

# %%
largest = {}
for scale in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0):
    there, _ = fit(draw(jax.random.key(1), scale))
    found = judge(there, scale)
    for name in ("mean", "variance", "std", "max"):
        if np.abs(getattr(found, name)).max() < 1e-4:
            largest[name] = scale
print("largest part of the ranges on which each statistic stays below 1e-4:", largest)
assert largest["variance"] > largest["max"]
