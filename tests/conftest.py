"""Settings that every test runs under, and the expensive things that tests share."""

import gc
import os
from functools import cache
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("NPROC", "1")  # see kjax.cli.configure_jax
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # see kjax.threads
# Compiling is most of the time. LLVM's optimisations cost a third of it, XLA's newer emitter of
# fused loops more than half of the rest (8.3 s to 3.3 s for ``solve_rows``), and reductions split
# up as trees a quarter of what is left. A flag that XLA does not know ends the process. Where a
# test's subject is not the LMPC's rows, its config has the box alone (friction and torque_fraction
# of inf), which compiles in a third of the time.
FLAGS = [
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_disable_hlo_passes=tree_reduction_rewriter",
    "--xla_cpu_parallel_codegen_split_count=1",  # a worker has one core
]
if version("jaxlib") == "0.10.2":  # that of constraints.txt
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))

import chex
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)  # so that what is sharded is sharded here as well
jax.config.update("jax_cpu_enable_async_dispatch", False)
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))
# Most of the time goes into hundreds of small programs, so that all of them are kept.
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

jax.block_until_ready(jax.jit(lambda x: x + 1)(0.0))  # XLA has read its flags now
# Tracing makes millions of objects that stay: looking through them again and again found nothing.
gc.set_threshold(50_000, 50, 50)

# Shapes and dtypes of annotated arguments are checked in tests only, so before kjax is imported.
CHECKED = (
    "kjax.dynamics.srb_planar",
    "kjax.koopman",
    "kjax.qp",
    "kjax.mpc",
    "kjax.gait",
    "kjax.legs",
)
install_import_hook(CHECKED, "beartype.beartype")

from kjax.dynamics import srb_planar
from kjax.koopman import dataset, edmd, observables
from kjax.robots import go1
from kjax.types import MODE_ALPHA, Leg

DT = 1e-3  # s, step of the shared snapshots


# The files that take longest, first: a worker that gets one last would leave the other idle.
LONGEST = (
    "test_mjx", "test_notebooks", "test_tune", "test_study", "test_whole_body", "test_free_base",
    "test_sensitivity", "test_runner", "test_loop", "test_excitation", "test_mujoco",
    "test_mujoco_batch", "test_closed_loop",
    "test_reproduce", "test_solvers", "test_rows",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """The longest files first; within a file, and between the others, the order stays."""
    place = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@pytest.fixture(autouse=True)
def _fresh_trace_counter():
    """``chex.assert_max_traces`` counts by name and line; start each test from zero."""
    chex.clear_trace_counter()


# Where every axis has a meaning, one that is left out must be said with None.
STRICT = ("qp", "koopman", "dynamics", "mpc", "gait", "prediction")


@pytest.fixture(autouse=True)
def _strict_rank_promotion(request):
    """In the maths an array meets another of its own rank, or the test fails."""
    room = request.path.parent
    strict = room.name in STRICT and room.parent.name == "tests"
    with jax.numpy_rank_promotion("raise" if strict else "allow"):
        yield


@pytest.fixture(autouse=True, scope="module")
def _drop_compiled_programs():
    """Let go of what a file compiled: a process may hold 65,530 mappings (Linux's default).

    Each program takes tens of them, the largest hundreds, and past the limit XLA crashes.
    """
    yield
    jax.clear_caches()
    gc.collect()


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """Both floating types; cast the inputs to it and ask for it back."""
    return np.dtype(request.param)


@pytest.fixture(scope="session")
def body():
    """A rigid body much like the Go1, float64."""
    return srb_planar.SrbParams(
        mass=jnp.asarray(12.7),
        inertia=jnp.asarray(0.39),
        feet=jnp.asarray([[0.19, -0.25], [-0.18, -0.26]]),
    )


@pytest.fixture(scope="session")
def draw(body):
    """Compiled sampler: (key, feet half-ranges (2,)) -> snapshots of all modes."""

    def ranges(feet_half):
        return dataset.SampleRanges(
            state_centre=jnp.array([0.0, 0.27, 0.0, 0.0, 0.0, 0.0]),
            state_half=jnp.array([0.5, 0.1, 0.3, 1.0, 0.5, 2.0]),
            input_low=jnp.array([-60.0, 0.0, -60.0, 0.0]),
            input_high=jnp.array([60.0, 150.0, 60.0, 150.0]),
            feet_half=feet_half,
        )

    def one(key, alpha, feet_half):
        return dataset.sample(key, body, alpha, ranges(feet_half), rollouts=40, steps=25, dt=DT)

    def modes(key, feet_half):
        keys = jax.random.split(key, len(MODE_ALPHA))
        return jax.vmap(one, in_axes=(0, 0, None))(keys, jnp.asarray(MODE_ALPHA, float), feet_half)

    return jax.jit(modes)


@pytest.fixture(scope="session")
def snapshots(draw):
    """Training data of every contact mode with the body's own contact points."""
    return draw(jax.random.key(0), jnp.zeros(2))


@pytest.fixture(scope="session")
def snapshots_moving_feet(draw):
    """Training data of every contact mode with contact points that vary between rollouts."""
    return draw(jax.random.key(1), jnp.array([0.12, 0.05]))


@pytest.fixture(scope="session")
def fit_modes():
    """Compiled EDMD over modes: (literal, feet_terms) -> function of stacked snapshots."""

    @cache
    def build(*, literal=False, feet_terms=False):
        dictionary = observables.paper(4, literal=literal)
        return jax.jit(jax.vmap(lambda data: edmd.fit(dictionary, data, feet_terms=feet_terms)))

    return build


@pytest.fixture(scope="session")
def fitted(fit_modes, snapshots):
    """Models and reports of all modes with the paper's dictionary, fixed contact points."""
    return fit_modes()(snapshots)


@pytest.fixture(scope="session")
def fitted_moving_feet(fit_modes, snapshots_moving_feet):
    """Models and reports of all modes whose input map depends on the contact points."""
    return fit_modes(feet_terms=True)(snapshots_moving_feet)


@pytest.fixture(scope="session")
def planar_go1():
    """Go1 in C MuJoCo on two slides and a pitch hinge, assembled here without ``kjax.sim``."""
    spec = mujoco.MjSpec.from_string(go1.MJCF.read_text(encoding="utf-8"))
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    trunk = spec.body("trunk")
    for name, kind, axis in (
        ("root_x", slide, [1, 0, 0]),
        ("root_z", slide, [0, 0, 1]),
        ("root_pitch", hinge, [0, 1, 0]),
    ):
        trunk.add_joint(name=name, type=kind, axis=axis, damping=[0, 0, 0], armature=0)
    return spec.compile()


@pytest.fixture(scope="session")
def free_go1():
    """Go1 in C MuJoCo on a free joint, assembled here without ``kjax.sim``."""
    spec = mujoco.MjSpec.from_string(go1.MJCF.read_text(encoding="utf-8"))
    spec.body("trunk").add_freejoint(name="root")
    return spec.compile()


@pytest.fixture(scope="session")
def leg_joints(planar_go1):
    """Joint ids (4, 3) by name: leg order of ``types.Leg``, then abduction, thigh, calf."""
    names = ("abduction", "thigh", "calf")
    return np.array([[planar_go1.joint(f"{leg.name}_{n}").id for n in names] for leg in Leg])


@pytest.fixture(scope="session")
def random_qp():
    """Factory of box QPs built from a known KKT point: seed -> (H, q, lower, upper, x), float64.

    A third of the variables rest at their lower bound, a third at the upper one, each pushed by a
    multiplier; the rest are free. The Jacobi-scaled Hessian has about the condition asked for.
    """

    def build(seed, *, n=12, condition=100.0):
        rng = np.random.default_rng(seed)
        basis, _ = np.linalg.qr(rng.normal(size=(n, n)))
        H = basis @ np.diag(np.geomspace(1.0, condition, n)) @ basis.T
        H = 0.5 * (H + H.T)
        x = rng.normal(size=n)
        push = rng.uniform(0.1, 2.0, n)  # strict complementarity
        kind = np.arange(n) % 3
        lower = np.where(kind == 0, x, x - rng.uniform(0.1, 2.0, n))
        upper = np.where(kind == 1, x, x + rng.uniform(0.1, 2.0, n))
        gradient = np.select([kind == 0, kind == 1], [push, -push], 0.0)
        return H, gradient - H @ x, lower, upper, x

    return build


@pytest.fixture(scope="session")
def standing_run():
    """Factory of made-up runs that stand still: (config, seconds, **fields) -> Trajectory."""
    from kjax.sim.trajectory import Trajectory

    def build(config, seconds, **fields):
        count = round(seconds / config.sim.sim_dt)
        quat = {"free": [0.0, 1.0, 0.0, 0.0, 0.0], "planar": [0.0]}[config.sim.base]
        pose = np.concatenate([[0.0, 0.27] if len(quat) == 1 else [0.0, 0.0], quat, np.zeros(12)])
        if len(quat) > 1:
            pose[2] = 0.27
        x = np.tile([0.0, 0.27, 0.0, 0.0, 0.0, 0.0], (count, 1))
        zeros = np.zeros(count)
        values = {
            "dt": config.sim.sim_dt,
            "time": np.arange(count) * config.sim.sim_dt,
            "qpos": np.tile(pose, (count, 1)),
            "qvel": np.zeros((count, len(pose) - (len(quat) > 1))),
            "x": x,
            "feet": np.zeros((count, 4, 2)),
            "foot_force": np.full((count, 4), 30.0),
            "torque": np.zeros((count, 4, 3)),
            "gait": np.zeros(count, int),
            "stance": np.ones((count, 4), bool),
            "force": np.zeros((count, 4, 2)),
            "velocity_command": zeros,
            "velocity_reference": zeros,
            "body_contact": np.zeros(count // 5, bool),
            "plan_status": np.ones(count // 5, int),
            "plan_residual": np.zeros(count // 5),
            "plan_iterations": np.ones(count // 5, int),
            "plan_time": np.full(count // 5, 1e-4),
            "act_time": np.full(count, 1e-5),
            "wall_time": 0.1,
            "fell": False,
            "interrupted": False,
        }
        return Trajectory(**{**values, **fields})

    return build


@pytest.fixture
def call(monkeypatch):
    """Run the ``main`` of a script with some words, in this process: its exit code."""
    from kjax import cli

    monkeypatch.setattr(cli, "configure_jax", lambda **more: None)  # it binds to cores

    def call(main, *words):
        with pytest.raises(SystemExit) as end:
            cli.run(main, [str(word) for word in words])
        return end.value.code

    yield call
    jax.config.update("jax_enable_x64", True)  # sweeps and benchmarks choose their own


@pytest.fixture(scope="session")
def repository():
    """Root folder of the checkout."""
    return Path(__file__).parents[1]
