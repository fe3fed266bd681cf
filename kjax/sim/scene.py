"""The scene: robot, base, ground and physics options, assembled with MjSpec."""

from functools import lru_cache
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from kjax.moved import moved_names
from kjax.robots import Robot
from kjax.sim.adapt import adapt
from kjax.sim.episode import SceneSpec, World
from kjax.sim.observe import Addresses, find_addresses
from kjax.sim.read_robot import load_spec
from kjax.sim.terrain import add_obstacles, place

_VIEWED = 0.426  # m, legs that the camera's place is for
_CONES = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
}


def build_spec(robot: Robot, scene: SceneSpec, *, visual: bool = True) -> mujoco.MjSpec:
    """MjSpec of a robot on its ground, open to further edits before ``compile``.

    Obstacles, floor, friction and payload are ``apply_world``'s.

    Args:
      robot: who stands there.
      scene: physics, and the number and types of obstacles.
      visual: whether to make it fit to look at; textures are 97 % of the compiled model, which a
        batch holds once per robot.
    """
    if not isinstance(scene, SceneSpec):
        raise TypeError(
            f"scene: wanted the SceneSpec of kjax.sim.resolve.resolve_scene(config), got "
            f"{type(scene).__name__}"
        )
    spec = _robot_spec(robot)
    spec.option.timestep = scene.sim_dt
    spec.option.cone = _CONES[scene.cone]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations = 30
    for joint in spec.joints:
        if scene.joint_damping is not None:
            joint.damping[0] = scene.joint_damping
        if scene.joint_armature is not None:
            joint.armature = scene.joint_armature
    for geom in spec.geoms:
        if scene.contacts == "feet" and geom.name not in robot.feet:
            geom.contype, geom.conaffinity = 0, 0
    _add_base(spec, robot.trunk, scene.base)
    _add_ground(spec, visual)
    if robot.is_read and not visual:
        spec.compiler.discardvisual = True  # meshes that only look like it: 84 MB of a B2
    if visual:
        length = float(robot.params.thigh_length + robot.params.calf_length)
        _add_looks(spec, robot.trunk, length / _VIEWED)
    add_obstacles(spec, scene.terrain, scene.obstacles)
    return spec


def build_model(robot: Robot, scene: SceneSpec, *, visual: bool = True) -> mujoco.MjModel:
    """Compiled model of a robot on its ground; ``apply_world`` puts the obstacles in place."""
    return build_spec(robot, scene, visual=visual).compile()


@lru_cache(maxsize=16)
def robot_addresses(robot: Robot, base: Literal["planar", "free"]) -> Addresses:
    """Where recorded positions of a robot on a base hold what, whatever the scene is."""
    spec = _robot_spec(robot)
    _add_base(spec, robot.trunk, base)
    return find_addresses(robot, spec.compile())


def apply_world(robot: Robot, model: mujoco.MjModel, world: World) -> None:
    """Give a compiled scene its obstacles, floor, friction and payload, in place.

    Raises:
      ValueError: for a field with another number of obstacles.
    """
    link = robot.trunk_link_mass
    own = float(robot.params.trunk_mass) if link is None else link
    model.body_mass[model.body(robot.trunk).id] = own + world.payload
    model.geom_friction[[model.geom(name).id for name in robot.feet], 0] = world.friction
    model.geom_pos[model.geom("ground").id, 2] = world.ground
    # Computes what follows from the mass as well.
    place(model, world.obstacles)


def _robot_spec(robot: Robot) -> mujoco.MjSpec:
    """The robot alone; meshes and textures are found beside an MJCF that is a file."""
    if robot.is_read:
        spec = load_spec(robot.mjcf)
        adapt(robot, spec)
    elif isinstance(robot.mjcf, Path):
        spec = mujoco.MjSpec.from_file(str(robot.mjcf))
    else:
        spec = mujoco.MjSpec.from_string(robot.mjcf.read_text(encoding="utf-8"))
    if spec.body(robot.trunk) is None:
        names = ", ".join(body.name for body in spec.bodies)
        raise ValueError(f"robot '{robot.name}': no body named '{robot.trunk}', there are {names}")
    return spec


def _add_base(spec: mujoco.MjSpec, body: str, base: str) -> None:
    """Joints of the trunk: two slides and a pitch hinge, or a free joint."""
    trunk = spec.body(body)
    if base == "free":
        trunk.add_freejoint(name="root")
        return
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    # MuJoCo's hinge about +y turns the nose down; sim.observe flips the sign.
    for name, kind, axis in (
        ("root_x", slide, [1, 0, 0]),
        ("root_z", slide, [0, 0, 1]),
        ("root_pitch", hinge, [0, 1, 0]),
    ):
        trunk.add_joint(name=name, type=kind, axis=axis, damping=[0, 0, 0], armature=0)


def _add_ground(spec: mujoco.MjSpec, visual: bool) -> None:
    """The plane that everything stands on."""
    spec.worldbody.add_geom(
        name="ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0, 0, 0],
        size=[0, 0, 0.05],
        contype=1,
        conaffinity=0,
        material="ground" if visual else "",
        rgba=[1.0, 1.0, 1.0, 1.0],
    )


def _add_looks(spec: mujoco.MjSpec, trunk: str, size: float) -> None:
    """Tiles, light, sky and a camera that follows the robot from its right side.

    Args:
      spec: of the scene.
      trunk: name of the robot's.
      size: of the robot against the Go1: how much further away it is looked at.
    """
    for texture in list(spec.textures):
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.85, 0.90, 0.95],
        rgb2=[1.0, 1.0, 1.0],
        width=256,
        height=256,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.78, 0.80, 0.82],
        rgb2=[0.86, 0.87, 0.88],
        width=256,
        height=256,
    )
    material = spec.add_material(name="ground", texrepeat=[4, 4], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    spec.body(trunk).add_light(
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[0, -0.6 * size, 3 * size],
        dir=[0, 0.2, -1],
    )
    spec.body(trunk).add_camera(
        name="side",
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[0.15 * size, -1.25 * size, 0.22 * size],
        xyaxes=[1, 0.12, 0, -0.02, 0.16, 1],
    )
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 720
    spec.stat.center = np.array([0.0, 0.0, 0.2])
    spec.stat.extent = 1.0


__getattr__ = moved_names(__name__)
