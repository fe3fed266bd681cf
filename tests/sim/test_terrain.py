"""Obstacle fields: data in ranges, one scene for all seeds, contacts where they should be."""

import dataclasses

import mujoco
import numpy as np
import pytest

from kjax.config import RunConfig, SimConfig, TerrainConfig, load_config
from kjax.legs.posture import stand_pose
from kjax.robots import go1
from kjax.sim import terrain
from kjax.sim.engines.mujoco import MujocoEngine, simulate
from kjax.sim.observe import find_addresses
from kjax.sim.resolve import (
    build_scene,
    resolve_episode,
    resolve_field,
    resolve_scene,
    resolve_world,
)
from kjax.sim.scene import apply_world, build_spec

KINDS = ("paper", "blocks", "steps", "slope", "cross_slope", "tiles", "patches")


def top(field, shape):
    """Height of the highest point of each obstacle that lies flat."""
    half = np.where(shape == mujoco.mjtGeom.mjGEOM_CAPSULE, field.size[:, 0], field.size[:, 2])
    return field.pos[:, 2] + half


def made(**terrain_keys):
    """The obstacles of a field, from where the robot starts."""
    return terrain.generate(resolve_field(RunConfig(terrain=TerrainConfig(**terrain_keys))))


def test_the_papers_field_has_eight_obstacles_of_5_to_7_cm_on_the_ground():
    for seed in range(50):
        field = made(kind="paper", seed=seed)
        height = top(field, np.array(terrain.shapes("paper", 8)))
        assert len(field.pos) == 8
        assert ((height >= 0.05) & (height <= 0.07)).all()
        np.testing.assert_allclose(height, 2 * field.pos[:, 2], atol=1e-12)
        assert ((field.pos[:, 0] > 0.75) & (field.pos[:, 0] < 2.65)).all()
        assert (np.diff(field.pos[:, 0]) > 0).all()


def test_blocks_cubes_and_capsules_take_turns():
    field = made(kind="paper")
    shapes = terrain.shapes("paper", 8)
    for i, shape in enumerate(shapes):
        assert (shape == mujoco.mjtGeom.mjGEOM_CAPSULE) == (i % 3 == 2)
        if i % 3 == 1:
            assert np.ptp(field.size[i]) == 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_gives_its_field_again_and_another_seed_another(kind):
    def make(seed):
        return made(kind=kind, seed=seed)

    for a, b in zip(make(3), make(3), strict=True):
        np.testing.assert_array_equal(a, b)
    different = any((a != b).any() for a, b in zip(make(3), make(4), strict=True))
    assert different == ("slope" not in kind)  # a slope has nothing random in it


@pytest.mark.parametrize("kind", KINDS)
def test_moving_the_obstacles_equals_compiling_the_other_field(kind):
    """Same physics: a ball dropped on the moved field does what it does on the compiled one."""
    first, second = (
        RunConfig(terrain=TerrainConfig(kind=kind, seed=seed), sim=SimConfig(base="planar"))
        for seed in (1, 2)
    )
    placed = build_scene(first)
    apply_world(go1.ROBOT, placed, resolve_world(second))
    spec = build_spec(go1.ROBOT, resolve_scene(second)[0])
    for geom, *values in zip(
        (geom for geom in spec.geoms if geom.name.startswith(terrain.PREFIX)),
        *made(kind=kind, seed=2),
        strict=True,
    ):
        geom.pos, geom.quat, geom.size, geom.friction[0] = values
    for geom in spec.geoms:
        if geom.name in go1.ROBOT.feet:
            geom.friction[0] = 0.8
    next(geom for geom in spec.geoms if geom.name == "ground").pos[2] = resolve_world(second).ground
    compiled = spec.compile()
    for name in ("geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_rbound"):
        np.testing.assert_allclose(getattr(placed, name), getattr(compiled, name), atol=1e-12)
    np.testing.assert_allclose(placed.geom_aabb, compiled.geom_aabb, atol=1e-12)
    states = []
    for model in (placed, compiled):
        data = mujoco.MjData(model)
        height, joints = stand_pose(go1.PARAMS, 0.27)
        data.qpos[find_addresses(go1.ROBOT, model).qpos] = joints
        data.qpos[:2] = 1.0, height + 0.1
        mujoco.mj_step(model, data, 300)
        states.append(data.qpos.copy())
    np.testing.assert_array_equal(*states)


def test_a_field_of_another_size_is_refused():
    model = build_scene(
        RunConfig(sim=SimConfig(base="planar"), terrain=TerrainConfig(kind="paper"))
    )
    with pytest.raises(ValueError, match="4 obstacles, the scene holds 8"):
        terrain.place(model, made(kind="slope"))


def ground_height(config, **sim):
    """Height of what lies at (x, y), by a ray of MuJoCo from above."""
    model = build_scene(RunConfig(sim=SimConfig(base="planar", **sim), terrain=config))
    data = mujoco.MjData(model)
    data.qpos[1] = 5.0  # the robot out of the way
    mujoco.mj_forward(model, data)

    def height(x, y):
        geom, down = np.zeros(1, np.int32), np.array([0.0, 0.0, -1.0])
        ray = mujoco.mj_ray(model, data, np.array([x, y, 3.0]), down, None, 1, -1, geom, None)
        return 3.0 - ray

    return height


@pytest.mark.parametrize("angle", [15.0, -20.0])
def test_a_slope_across_the_way_rises_to_the_side(angle):
    height = ground_height(TerrainConfig(kind="cross_slope", slope=angle, width=1.2))
    rise = np.tan(np.radians(angle))
    for x in (0.85, 1.7, 2.55):
        for y in (-0.5, 0.0, 0.13, 0.5):
            assert height(x, y) == pytest.approx(y * rise, abs=1e-6)
    for x in (-1.0, 0.75, 2.65, 5.0):
        assert height(x, 0.3) == pytest.approx(0.0, abs=1e-6)


def test_tiles_cover_the_field_with_heights_in_range():
    config = TerrainConfig(kind="tiles", count=5, height_min=0.02, height_max=0.06, width=1.2)
    height = ground_height(config)
    x = np.linspace(0.81, 2.59, 30)
    seen = np.array([[height(a, b) for b in np.linspace(-0.59, 0.59, 30)] for a in x])
    assert seen.min() >= 0.02 - 1e-9
    assert seen.max() <= 0.06 + 1e-9
    assert len(np.unique(seen.round(9))) == 30
    assert height(0.79, 0.0) == height(2.61, 0.0) == pytest.approx(0.0, abs=1e-9)


def test_a_slope_rises_at_its_angle_and_meets_the_plateau():
    config = TerrainConfig(kind="slope", slope=10.0)
    model = build_scene(RunConfig(sim=SimConfig(base="planar"), terrain=config))
    data = mujoco.MjData(model)
    data.qpos[1] = 5.0  # the robot out of the way
    mujoco.mj_forward(model, data)

    def height(x):
        geom = np.zeros(1, np.int32)
        down = np.array([0.0, 0.0, -1.0])
        ray = mujoco.mj_ray(model, data, np.array([x, 0.0, 3.0]), down, None, 1, -1, geom, None)
        return 3.0 - ray

    rise = np.tan(np.radians(10.0))
    for x in (0.9, 1.1, 1.3):
        assert height(x) == pytest.approx((x - config.start) * rise, abs=1e-6)
        mirrored = config.start + config.end - x
        assert height(mirrored) == pytest.approx(height(x), abs=1e-6)
    assert height(1.7) == pytest.approx(0.6 * rise, abs=1e-6)


def test_a_slope_downwards_starts_level_and_comes_up_again():
    config = TerrainConfig(kind="slope", slope=-10.0)
    model = build_scene(RunConfig(sim=SimConfig(base="planar", floor=0.5), terrain=config))
    data = mujoco.MjData(model)
    data.qpos[1] = 5.0  # the robot out of the way
    mujoco.mj_forward(model, data)

    def height(x):
        geom = np.zeros(1, np.int32)
        down = np.array([0.0, 0.0, -1.0])
        ray = mujoco.mj_ray(model, data, np.array([x, 0.0, 3.0]), down, None, 1, -1, geom, None)
        return 3.0 - ray - 0.5

    drop = np.tan(np.radians(10.0))
    for x in (-1.0, 0.0, 0.79, 2.61, 4.0):
        assert height(x) == pytest.approx(0.0, abs=1e-6)
    for x in (0.9, 1.1, 1.3):
        assert height(x) == pytest.approx(-(x - config.start) * drop, abs=1e-6)
        mirrored = config.start + config.end - x
        assert height(mirrored) == pytest.approx(height(x), abs=1e-6)
    assert height(1.7) == pytest.approx(-0.6 * drop, abs=1e-6)


def test_a_patch_is_slippery_under_a_foot():
    """A foot's priority overrules the ground's friction; a patch overrules the foot's."""
    config = TerrainConfig(kind="patches", patch_friction=0.2, start=0.19, end=0.6, count=1)
    model = build_scene(RunConfig(sim=SimConfig(base="planar"), terrain=config))
    data = mujoco.MjData(model)
    height, joints = stand_pose(go1.PARAMS, 0.27)
    data.qpos[find_addresses(go1.ROBOT, model).qpos] = joints
    data.qpos[1] = height
    mujoco.mj_forward(model, data)
    friction = {}
    for contact in data.contact:
        names = {model.geom(g).name for g in contact.geom}
        patch = any(name.startswith(terrain.PREFIX) for name in names)
        friction.setdefault(patch, set()).add(round(float(contact.friction[0]), 6))
    assert friction == {True: {0.2}, False: {0.8}}


def test_heights_follow_the_ground_under_the_stance_feet():
    """Standing on a plateau: measured from the floor the robot would sink onto its knees."""
    rise = 0.06
    common = {
        "duration": 1.0,
        "command.times": [0.0],
        "command.v_x": [0.0],
        "terrain.kind": "steps",
        "terrain.count": 1,
        "terrain.start": 0.001,
        "terrain.end": 4.0,
        "terrain.height_min": rise,
        "terrain.height_max": rise,
        "noise.enabled": False,
        "sim.base": "planar",
    }
    config = load_config(RunConfig, None, common)
    episode = resolve_episode(config)
    lifted = episode.start._replace(pose=episode.start.pose + np.array([1.0, rise, 0.0]))
    episode = dataclasses.replace(episode, start=lifted)
    run = simulate(MujocoEngine(episode.spec), episode)
    assert not run.fell
    # 5 mm: what is left of the droop under the legs' own weight
    assert run.x[-200:, 1].mean() == pytest.approx(0.27 + rise, abs=0.005)
