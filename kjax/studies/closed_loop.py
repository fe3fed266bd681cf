"""Closed loop under the Koopman LMPC in MuJoCo: one run, or one per seed.

Leaves metrics.json, config.toml, trajectory.npz, figure.png and, if asked for, video.mp4 in the
output folder. Ctrl-C stops the run and writes what was simulated, but no metrics of it, which would
read like those of a whole run. With --seeds, runs that are already in the folder's seeds.json (same
config, same code) are not repeated; a folder of another config or other code is refused.
"""

import dataclasses
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kjax import cli
from kjax.config import ConfigError, RunConfig
from kjax.options import Count, RunOptions, fail, parse_config, require
from kjax.runs.cache import Cache, open_cache
from kjax.sim.engines.mujoco import MujocoEngine, OnTick, simulate
from kjax.sim.metrics import SETTLE_TIME, metrics
from kjax.sim.resolve import batch_spec, resolve_episode, resolve_goal
from kjax.sim.summary import summarise
from kjax.sim.trajectory import Trajectory

# What the table shows: metric, printed name, format.
TABLE = (
    ("velocity_rmse_mps", "velocity RMSE [m/s]", ".4f"),
    ("velocity_reference_rmse_mps", "RMSE of the slewed reference [m/s]", ".4f"),
    ("velocity_late_rmse_mps", "RMSE 2 s after the last step [m/s]", ".4f"),
    ("pitch_max_deg", "pitch, largest [deg]", ".2f"),
    ("pitch_p95_deg", "pitch, 95 % [deg]", ".2f"),
    ("field_pitch_p95_deg", "pitch in the field, 95 % [deg]", ".2f"),
    ("switch_time_s", "gait switched at [s]", ".3f"),
    ("switch_pitch_max_deg", "pitch after it, largest [deg]", ".2f"),
    ("pitch_settle_s", "pitch settled after [s]", ".3f"),
    ("roll_max_deg", "roll, largest [deg]", ".2f"),
    ("yaw_max_deg", "yaw, largest [deg]", ".2f"),
    ("velocity_y_rmse_mps", "RMSE of the sideways velocity [m/s]", ".4f"),
    ("yaw_rate_rmse_radps", "RMSE of the yaw rate [rad/s]", ".4f"),
    ("path_error_max_m", "distance from the path asked for, largest [m]", ".3f"),
    ("heading_error_max_deg", "error of the heading, largest [deg]", ".2f"),
    ("lateral_drift_m", "sideways drift, largest [m]", ".3f"),
    ("height_mean_m", "CoM height, mean [m]", ".3f"),
    ("height_error_max_m", "CoM height, largest error [m]", ".3f"),
    ("foot_slip_m", "foot slip per stance [m]", ".4f"),
    ("torque_saturation_fraction", "time with a saturated joint [-]", ".4f"),
    ("knee_saturation_fraction", "time with a saturated knee [-]", ".4f"),
    ("body_contact_fraction", "time with knee or trunk on the ground [-]", ".4f"),
    ("qp_unsolved", "QPs not solved", ".0f"),
    ("plan_ms_median", "plan, median [ms]", ".3f"),
    ("act_ms_median", "act, median [ms]", ".3f"),
    ("realtime_factor", "real-time factor [-]", ".1f"),
)


# What metrics.json holds of a run that was interrupted.
INTERRUPTED = ("interrupted", "simulated_s", "fell", "fall_time_s")


@dataclass(kw_only=True)
class RunCommand(RunOptions):
    """Options of a run."""

    seeds: Count = None
    """Run this many seeds, from config key 'seed' on."""

    video: bool = False
    """Also write video.mp4."""

    view: bool = False
    """Show the run in MuJoCo's viewer."""

    restart: bool = False
    """With --seeds: drop the seeds that the folder holds."""


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run."""
    config, args = parse_config(RunCommand, argv, __doc__.splitlines()[0])
    require(args, "seeds", least=1)
    if args.view and args.seeds is not None:
        fail("--view: shows a single run, leave --seeds out")
    if args.restart and args.seeds is None:
        fail("--restart: belongs to --seeds; a single run always starts afresh")
    if args.view:
        require_display()
    cli.configure_jax(one_core=True)
    folder = cli.output_folder(args, "closed_loop")
    cache = None if args.seeds is None else open_cache(folder, fresh=args.restart)
    clock = time.perf_counter()
    try:
        simulation = MujocoEngine(batch_spec(config))
        simulation.program(resolve_episode(config))
    except ConfigError as error:
        fail(str(error))
    print(f"models fitted, controller compiled: {time.perf_counter() - clock:.1f} s", flush=True)
    run: Trajectory | None
    if cache is None:
        run = _simulate_with_bar(simulation, config, view=args.view)
        result = metrics(run, resolve_goal(config))
        if run.interrupted:
            print(f"interrupted {_progress(run, config)}: no metrics")
            result = {key: result[key] for key in INTERRUPTED}
        else:
            print_table([result])
            if config.duration <= SETTLE_TIME:
                print(f"no metrics: the first {SETTLE_TIME} s, from standing, are left out")
        cli.save_json(folder / "metrics.json", result)
    else:
        run, config = run_seeds(simulation, config, args.seeds or 1, cache, folder)
    if run is not None:
        save_run(run, config, folder, args)
    if run is not None and run.interrupted:
        print(f"what was simulated is in {folder}/")
        return 130
    print(f"{time.perf_counter() - clock:.0f} s in all; results in {folder}/")
    return 0


def save_run(run: Trajectory, config: RunConfig, folder: Path, args: RunCommand) -> None:
    """Write trajectory, config, figure and, if asked for, the video."""
    from kjax.viz.plots import closed_loop_figure

    run.save(folder / "trajectory.npz")
    cli.save_config(folder / "config.toml", config)
    title = folder.name + (f", interrupted {_progress(run, config)}" if run.interrupted else "")
    closed_loop_figure(run, config, folder / "figure.png", title=title)
    if args.video:
        from kjax.viz.video import save_video

        print(
            "video:",
            save_video(folder / "trajectory.npz", folder / "config.toml", folder / "video.mp4"),
        )


def _simulate_with_bar(
    simulation: MujocoEngine, config: RunConfig, *, view: bool = False, label: str = ""
) -> Trajectory:
    with tqdm(total=config.duration, unit="s", desc=label or "simulated", leave=False, disable=None,
              bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.1f}/{total:.1f} s "
              "[{elapsed}<{remaining}, {rate_fmt}]") as bar:  # fmt: skip

        def on_tick(done: int, total: int, data: Any) -> None:
            if done % 100 == 0 or done == total:
                bar.update(done * config.sim.sim_dt - bar.n)

        if not view:
            return simulate(simulation, resolve_episode(config), on_tick=on_tick)
        return _simulate_in_viewer(simulation, config, on_tick)


def _progress(run: Trajectory, config: RunConfig) -> str:
    return f"at {len(run.time) * run.dt:.2f} s of {config.duration:g} s"


def require_display() -> None:
    """End the program where no window can be opened, before anything is compiled."""
    try:
        import glfw
        import mujoco.viewer
    except ImportError as error:
        fail(f"--view: no window can be opened here ({error}); try --video")
    if sys.platform == "darwin" and mujoco.viewer._MJPYTHON is None:
        fail("--view: on macOS start it by mjpython instead of python; or try --video")
    # MuJoCo's viewer ends the process where there is no display, so ask first.
    with warnings.catch_warnings(action="ignore"):
        if not glfw.init():
            fail("--view: no window can be opened here (no display?); try --video")


def _simulate_in_viewer(simulation: MujocoEngine, config: RunConfig, on_tick: OnTick) -> Trajectory:
    """Run at real-time pace in MuJoCo's passive viewer."""
    import mujoco.viewer

    viewer: Any = None
    begin = time.perf_counter()

    def show(done: int, total: int, data: Any) -> None:
        nonlocal viewer, begin
        on_tick(done, total, data)
        if viewer is None:
            viewer = mujoco.viewer.launch_passive(simulation.model, data)
            begin = time.perf_counter() - done * config.sim.sim_dt
        if not viewer.is_running():
            raise KeyboardInterrupt
        viewer.sync()
        ahead = done * config.sim.sim_dt - (time.perf_counter() - begin)
        if ahead > 0:
            time.sleep(ahead)

    try:
        return simulate(simulation, resolve_episode(config), on_tick=show)
    finally:
        if viewer is not None:
            viewer.close()


def run_seeds(
    simulation: MujocoEngine, config: RunConfig, count: int, cache: Cache, folder: Path
) -> tuple[Trajectory | None, RunConfig]:
    """Run seeds, each kept as it ends; returns the first run of this call and its config.

    Each seed is one of noise and, where there are obstacles, of their field as well. ``seeds.json``
    holds those that are finished, of this config and code.
    """
    chosen = {
        seed: dataclasses.replace(
            config, seed=seed, terrain=dataclasses.replace(config.terrain, seed=seed)
        )
        for seed in range(config.seed, config.seed + count)
    }
    keys = {seed: cache.key(this) for seed, this in chosen.items()}
    first, first_config = None, config
    for seed, this in chosen.items():
        if keys[seed] not in cache:
            run = _simulate_with_bar(simulation, this, label=f"seed {seed}")
            if run.interrupted:
                print(f"interrupted in seed {seed} {_progress(run, this)}; finished seeds are "
                      "kept, run the same command again to go on")  # fmt: skip
                return run, this
            if first is None:
                first, first_config = run, this
            cache.add({keys[seed]: metrics(run, resolve_goal(this))})
        done = {str(s): cache[key] for s, key in keys.items() if key in cache}
        cli.save_json(
            folder / "seeds.json",
            {"provenance": cli.provenance(), "seeds": done, **summarise(done.values())},
        )
    print_table([cache[key] for key in keys.values()])
    return first, first_config


def print_table(results: list[dict[str, Any]]) -> None:
    """One column for a single run; median and worst for several."""
    total = summarise(results)
    several = len(results) > 1
    print(f"{'':42}{'median':>10}{'worst':>10}" if several else "")
    for key, name, form in TABLE:
        if key in total:
            median, worst = (format(total[key][k], form) for k in ("median", "worst"))
            print(f"{name:42}{median:>10}" + (f"{worst:>10}" if several else ""))
    crossed = [result["crossed"] for result in results if "crossed" in result]
    if crossed:
        print(f"{'crossed the field':42}{sum(crossed):>7}/{len(crossed)}")
    for result in results:
        if result["fell"]:
            print(f"FELL at {result['fall_time_s']:.2f} s")
    if several:
        print(f"{total['runs']} runs, {total['falls']} falls")


if __name__ == "__main__":
    cli.run(main)
