# ---
# jupyter:
#   jupytext:
#     formats: py:percent
# ---

# %% [markdown]
# # What lifting buys: linear, bilinear, exact
#
# With forces in the body frame the rigid body holds `R(theta) F`: a product of state and input. No
# constant input map holds it, whatever the observables. A *bilinear* model whose dictionary holds
# `R` itself does; and with forces and feet fixed in space the step is bilinear *exactly*, in seven
# observables.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

jax.config.update("jax_enable_x64", True)

from kjax.config import SrbConfig  # noqa: E402
from kjax.controllers.rigid_body import own_body  # noqa: E402
from kjax.koopman import edmd, observables  # noqa: E402
from kjax.koopman.dataset import DatasetSpec, sample, sample_ranges  # noqa: E402
from kjax.prediction import evaluation, families  # noqa: E402
from kjax.robots import get_robot  # noqa: E402
from kjax.types import MODE_ALPHA, Mode  # noqa: E402

DT, STEPS = 1e-3, 200
body = jax.tree.map(jnp.asarray, own_body(SrbConfig(), get_robot().params))
alpha = jnp.asarray(MODE_ALPHA[Mode.TROT], float)
ranges = sample_ranges(DatasetSpec())
data = jax.jit(lambda k: sample(k, body, alpha, ranges, rollouts=100, steps=100, dt=DT))(
    jax.random.key(1)
)

# %% [markdown]
# ## Five models behind one interface
#
# A family is a record of two pure functions, `lift` and `step`; its parameters are data. Your own
# dictionary is one line.

# %%
plain = observables.paper(4)
with_rotation = observables.paper(4, constant_rotation=True)
mine = observables.custom_dictionary(
    lambda x: jnp.stack([jnp.cos(x[2]), jnp.sin(x[2]), x[5] * jnp.sin(x[2])])
)
known = families.BodyModel(body, alpha)
models = {
    "linear EDMD (the paper)": (families.linear(plain, DT), edmd.fit(plain, data)[0], "body"),
    "linear EDMD, my own observables": (families.linear(mine, DT), edmd.fit(mine, data)[0], "body"),
    "bilinear EDMD": (families.bilinear(plain, DT), edmd.fit_bilinear(plain, data)[0], "body"),
    "bilinear EDMD with R": (
        families.bilinear(with_rotation, DT),
        edmd.fit_bilinear(with_rotation, data)[0],
        "body",
    ),
    "exact (forces fixed in space)": (families.exact(DT), known, "space"),
}

# %%
starts = sample(jax.random.key(2), body, alpha, ranges, rollouts=20, steps=1, dt=DT).states[:, 0]
forces = sample(jax.random.key(3), body, alpha, ranges, rollouts=20, steps=STEPS, dt=DT).inputs
worst = {}
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for name, (family, params, plant) in models.items():
    errors = jax.jit(
        lambda s, f, family=family, params=params, plant=plant: evaluation.model_errors(
            family, params, plant, body, alpha, s, f
        )
    )(starts, forces)
    velocity = np.abs(errors[..., 3:5]).max(axis=(0, 1, 3))
    worst[name] = velocity[49]
    ax.semilogy(np.arange(1, STEPS + 1), velocity + 1e-17, label=name)
ax.set(xlabel="time [ms]", ylabel="largest error of the velocity [m/s]")
ax.legend(fontsize=8)
plt.show()
for name, value in worst.items():
    print(f"{name:34} {value:.1e} m/s after 50 ms")
assert worst["bilinear EDMD with R"] < 1e-3 * worst["linear EDMD (the paper)"]

# %% [markdown]
# ## What an LMPC gets of it
#
# A linear MPC needs one `A` and `B` for the horizon. `operating_point` linearises any family where
# the robot is; `koopman.model = "bilinear"` (or `exact`, `srb`, `planted`) in a config does so at
# every tick. The re-linearised rigid body is then hard to beat: the error that is left is the
# curvature along the horizon, which all of them share.

# %%
start = families.Start(starts[0], body.feet)
here = families.operating_point(
    *models["bilinear EDMD with R"][:2], start, families.hover(body, alpha), steps=20
)
print("A over 20 ms:", here.A.shape, " B:", here.B.shape)
