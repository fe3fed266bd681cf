"""From a config to episodes: the only module of ``kjax.sim`` that reads configs."""

from collections.abc import Hashable, Sequence
from dataclasses import fields, replace
from functools import lru_cache

import mujoco
import numpy as np

from kjax.config import NoiseConfig, PushConfig, RunConfig
from kjax.config.gaits import gait_setting
from kjax.config.units import in_si
from kjax.controllers.params import ControllerParams
from kjax.controllers.resolve import build_command, controller_key, controller_spec, resolve
from kjax.controllers.walkable import build_gaits
from kjax.files import file_hashes
from kjax.legs.posture import stand_pose
from kjax.moved import moved_names
from kjax.robots import get_robot
from kjax.sim import free_base
from kjax.sim.episode import (
    BatchSpec,
    Episode,
    EpisodeParams,
    Goal,
    SceneSpec,
    Start,
    World,
    initial_state,
)
from kjax.sim.observe import find_addresses
from kjax.sim.scene import apply_world, build_model
from kjax.sim.terrain import Field, generate, ground_level, place_at, track_of
from kjax.spec import ControllerSpec


def resolve_episode(
    config: RunConfig, *, seed: int | None = None, terrain_seed: int | None = None
) -> Episode:
    """The episode of a config; fits the Koopman models where none of a config like it is at hand.

    Args:
      config: of the run.
      seed: of noise and start, in place of the config's.
      terrain_seed: of the obstacles, likewise.

    Raises:
      ValueError: for a config that the robot cannot walk with, naming the key.
    """
    if seed is not None:
        config = replace(config, seed=seed)
    if terrain_seed is not None:
        config = replace(config, terrain=replace(config.terrain, seed=terrain_seed))
    spec, params = resolve_scene(config)
    shared = _controller(config)
    goal = _goal(config, spec)
    return Episode(
        spec=BatchSpec(controller=_controller_spec(config), scene=spec),
        controller=shared._replace(
            gait_times=goal.gait_times,  # type: ignore[arg-type]
            command=goal.command,
        ),
        params=params,
        world=resolve_world(config),
        start=resolve_start(config),
        goal=goal,
    )


def resolve_episodes(configs: Sequence[RunConfig]) -> list[Episode]:
    """The episodes of configs; those that differ in nothing else share their fits."""
    return [resolve_episode(config) for config in configs]


def batch_spec(config: RunConfig) -> BatchSpec:
    """Spec of a config: those with an equal one may walk in one compiled batch."""
    return BatchSpec(controller=_controller_spec(config), scene=resolve_scene(config)[0])


def resolve_scene(config: RunConfig) -> tuple[SceneSpec, EpisodeParams]:
    """Spec of the scene that a robot walks in, and what it meets there."""
    sim, terrain, noise, push = config.sim, config.terrain, config.noise, config.push
    force_noise = noise.force * noise.enabled
    spec = SceneSpec(
        robot=config.robot,
        base=sim.base,
        sim_dt=sim.sim_dt,
        cone=sim.cone,
        contacts=sim.contacts,
        joint_damping=sim.joint_damping,
        joint_armature=sim.joint_armature,
        contact_threshold=sim.contact_threshold,
        terrain=terrain.kind,
        obstacles=terrain.count,
        noise=noise.enabled,
        force_noise=force_noise > 0,
    )
    steps, count = round(push.duration / sim.sim_dt), len(push.times)
    force = np.zeros((count, 3))
    force[:, :2] = _impulses(push) / (steps * sim.sim_dt)
    begin = np.array([round(time / sim.sim_dt) for time in push.times], np.int32)
    return spec, EpisodeParams(
        seed=np.int32(config.seed),
        noise_scale=noise_scale(noise, sim.base).astype(np.float32),
        force_noise=np.float32(force_noise),
        push_begin=begin,
        push_steps=np.full(count, steps, np.int32),
        push_force=force,
        delay=np.int32(round(sim.delay / sim.sim_dt)),
        origin=_origin(config),
    )


def resolve_goal(config: RunConfig) -> Goal:
    """What a config asks for; ``metrics`` measure an episode against it."""
    return _goal(config, resolve_scene(config)[0])


def _goal(config: RunConfig, scene: SceneSpec) -> Goal:
    si, terrain = in_si(config, get_robot(config.robot).params), config.terrain
    heights = [gait_setting(si, one.name, "body_height") for one in build_gaits(config)]
    return Goal(
        scene=scene,
        duration=config.duration,
        command=build_command(config.command),
        gait_times=np.asarray(config.gait.times, float),
        heights=np.array(heights, float),
        slews=np.array([si.lmpc.command_slew, si.spatial.yaw_slew], float),
        field=(terrain.start, terrain.end),
    )


def resolve_field(config: RunConfig) -> Field:
    """The obstacle field of a config, seen from the robot's start."""
    terrain = config.terrain
    return Field(
        track=track_of(get_robot(config.robot).params),
        friction=config.sim.friction,
        **{
            one.name: getattr(terrain, one.name)
            for one in fields(Field)
            if one.name not in ("track", "friction")
        },
    )


def resolve_world(config: RunConfig) -> World:
    """The world of a config: obstacles from where the robot starts, floor, friction, payload."""
    sim, field = config.sim, resolve_field(config)
    heading = sim.heading if sim.base == "free" else 0.0
    return World(
        obstacles=place_at(generate(field), _origin(config), heading),
        ground=sim.floor + ground_level(field),
        friction=sim.friction,
        payload=sim.payload,
    )


def resolve_start(config: RunConfig) -> Start:
    """The robot, standing, disturbed as the config and its seed say."""
    robot = get_robot(config.robot).params
    si = in_si(config, robot)
    height, joints = stand_pose(robot, float(gait_setting(si, config.gait.names[0], "body_height")))
    pose, rates = np.zeros(3), np.zeros(3)
    pose[1] = height
    spread, noise = config.noise, np.random.default_rng([config.seed, 0])
    if spread.enabled:
        pitch = spread.initial_pitch * noise.standard_normal()
        pose[2] = -pitch
        # Keep the lower pair of feet on the ground rather than in it.
        pose[1] += abs(np.sin(pitch)) * robot.hip_pos[0, 0]
        rates[:2] = spread.initial_velocity * noise.standard_normal(2)
        rates[2] = -spread.initial_pitch_rate * noise.standard_normal()
    if config.sim.base == "free":
        pose, rates = free_base.from_planar(pose, rates)
        free_base.turn(pose, rates, config.sim.heading)
        pose[:3] += _origin(config)
    else:
        pose[:2] += _origin(config)[::2]
    return Start(pose=pose, rates=rates, joints=joints)


def build_scene(config: RunConfig, *, visual: bool = True) -> mujoco.MjModel:
    """The compiled model of a config's scene, its obstacles in place."""
    robot = get_robot(config.robot)
    model = build_model(robot, resolve_scene(config)[0], visual=visual)
    apply_world(robot, model, resolve_world(config))
    return model


def start_state(config: RunConfig, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Qpos (nq,) and qvel (nv,) of a config's start, in a model of its robot and base."""
    return initial_state(
        resolve_start(config), model, find_addresses(get_robot(config.robot), model)
    )


def noise_scale(noise: NoiseConfig, base: str) -> np.ndarray:
    """Standard deviation (n,) of each entry of a base's noise vector; zero where noise is off."""
    scale = np.concatenate(
        [
            [noise.position, noise.position, noise.pitch],
            [noise.velocity, noise.velocity, noise.pitch_rate],
            np.full(12, noise.joint_position),
            np.full(12, noise.joint_velocity),
        ]
    )
    if base == "free":
        sideways = [noise.position, noise.pitch, noise.pitch]
        rates = [noise.velocity, noise.pitch_rate, noise.pitch_rate]
        scale = np.concatenate([scale, sideways, rates])
    return scale * noise.enabled


def _impulses(push: PushConfig) -> np.ndarray:
    """Forward and lateral impulse of every push (P, 2) [N s]."""
    each = [np.broadcast_to(value, len(push.times)) for value in (push.forward, push.lateral)]
    return np.stack(each, axis=-1).astype(float)


def _origin(config: RunConfig) -> np.ndarray:
    """Where the robot starts, on the floor (3,), world [m]; recordings are measured from it."""
    sim = config.sim
    return np.array([sim.start[0], sim.start[1] if sim.base == "free" else 0.0, sim.floor])


def _controller_spec(config: RunConfig) -> ControllerSpec:
    # A file, or a module of one's own, may have changed since.
    if config.koopman.file or ":" in config.koopman.model:
        return controller_spec(config)
    return _cached_spec(config)


@lru_cache(maxsize=8192)
def _cached_spec(config: RunConfig) -> ControllerSpec:
    return controller_spec(config)


_KEPT = 64  # controllers whose parameters are kept
_controllers: dict[Hashable, ControllerParams] = {}


def _controller(config: RunConfig) -> ControllerParams:
    """Parameters of a config's controller, kept for configs that differ elsewhere."""
    key = (controller_key(config), *file_hashes(config).values())
    if key not in _controllers:
        while len(_controllers) >= _KEPT:
            _controllers.pop(next(iter(_controllers)))
        _controllers[key] = resolve(config)[1]
    return _controllers[key]


__getattr__ = moved_names(__name__)
