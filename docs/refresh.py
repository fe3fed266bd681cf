"""Write the tables and pictures of the README and the docs again, from the recorded results.

    python docs/refresh.py
    python docs/refresh.py --notebooks     # runs them, minutes

A table stands between two comments, ``<!-- table: NAME -->`` and ``<!-- end -->``; NAME is a
function below, which reads JSON in ``docs/results/``. Sentences that quote a
number are in ``docs/quotes.py``. A test compares all of them with what stands there.
"""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from quotes import QUOTES, SHORT

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = ("README.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")))
BLOCK = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)

PLACEHOLDER = re.compile(r"\{([^{}|]+?) \| (?:([\d.e+-]+) \* )?([^{} ]+)\}")
NUMBER = r"(-?\d[\d.]*\d(?:e-?\d+)?|\d)"

LIMIT = 300_000  # bytes of an executed notebook

TABLES: dict[str, Callable[[], str]] = {}


def table(function: Callable[[], str]) -> Callable[[], str]:
    """Make a function's text available under its name."""
    TABLES[function.__name__] = function
    return function


def load(name: str, file: str = "metrics.json") -> Any:
    """Recorded results of a command."""
    return json.loads((RESULTS / name / file).read_text(encoding="utf-8"))


def markdown(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [header, ("---",) * len(header), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def recorded(name: str, file: str = "metrics.json") -> str:
    """When, where and at which revision results were made."""
    found = load(name, file)["provenance"]
    return (
        f"{found['created'][:10]}, {found['machine']}, jax {found['versions']['jax']}, "
        f"revision {found['git_revision'][:7]}"
    )


class Reproduced:
    """The episodes of ``make reproduce``, by experiment and base."""

    def __init__(self) -> None:
        self.found = load("reproduce", "results.json")["experiments"]

    def row(self, experiment: str, base: str, metric: str) -> dict[str, Any]:
        """Median, interval and worst of a metric."""
        rows = self.found[experiment][base]["rows"]
        return next(row for row in rows if row["metric"] == metric)

    def median(self, experiment: str, base: str, metric: str, form: str) -> str:
        """The median, formatted."""
        return format(self.row(experiment, base, metric)["median"], form)

    def both(self, experiment: str, metric: str, form: str) -> str:
        """The planar median, and the free base's in parentheses."""
        planar, free = (self.median(experiment, base, metric, form) for base in ("planar", "free"))
        return f"**{planar}** ({free})"

    def count(self, experiment: str, base: str, what: str) -> tuple[int, int]:
        """How many episodes fell, or crossed, of how many."""
        summary = self.found[experiment][base]["summary"]
        return int(summary[what]), int(summary["runs"])


@table
def readme_results() -> str:
    """What the README says beside the paper."""
    got, speed = Reproduced(), load("benchmark_controller")
    rmse = "velocity_rmse_mps"
    rough = {}
    for name in ("trot_rough", "bound_rough"):
        (planar, of), (free, _) = (got.count(name, base, "crossed") for base in ("planar", "free"))
        rough[name] = f"{planar} of {of} ({free})"
    fell, of = got.count("bound_to_trot", "planar", "falls")
    peak = [got.median("bound_to_trot", b, "switch_pitch_max_deg", ".1f") for b in BASES]
    return markdown(
        ("", "paper", "kjax"),
        [
            ("trot through the velocity profile: RMSE of v_x [m/s]", "0.029",
             got.both("trot_velocity", rmse, ".4f")),
            ("the same, predicting 0.2 s instead of 6 ms", "",
             got.both("trot_velocity_long", rmse, ".4f")),
            ("bound, the paper's timing: RMSE of v_x [m/s]", "0.189",
             got.both("bound_multiphase", rmse, ".3f")),
            ("the same with the paper's horizon, within the stance", "0.189",
             got.both("bound_velocity", rmse, ".3f")),
            ("trot over the paper's rough field: crossed", "one run", rough["trot_rough"]),
            ("bound over it at 0.75 m/s: crossed", "one run", rough["bound_rough"]),
            ("bound to trot in flight: fell; largest pitch", "smooth",
             f"{fell} of {of}; {peak[0]}° ({peak[1]}°)"),
            ("plan, act [ms]", "about 3 (QP alone)",
             f"{speed['plan_ms_median']:.2f}, {speed['act_ms_median']:.2f}"),
        ],
    )  # fmt: skip


BASES = ("planar", "free")


@table
def readme_speed() -> str:
    """Four figures of speed."""
    loop, batch = load("benchmark_controller"), load("benchmark_simulation")
    box = load("benchmark_qp")["box"]["trot_velocity"]
    device = load("benchmark_device")["devices"]["gpu"]
    ticks = max(device["controller"].values(), key=lambda entry: entry["per_s"])
    walks = max(device["mjx"].values(), key=lambda entry: entry["per_s"])
    scan, daqp = (box[k]["us_median"] for k in ("kjax in a scan, value", "daqp, warm"))
    return markdown(
        ("", ""),
        [
            ("one robot at 1 kHz in C MuJoCo, one core",
             f"{loop['realtime_factor']:.1f} x real time"),
            ("1,024 robots in C MuJoCo, two cores",
             f"{batch['c']['trot, held, 1024']['robot_steps_per_s'] / 1e3:.0f} k steps/s, "
             f"{batch['c_held_over_bare']:.2f} of bare MuJoCo"),
            ("the trot's QP (24 forces) in a scan, warm; daqp", f"{scan:.1f} µs; {daqp:.1f} µs"),
            ("one H200: controllers; robots on MJX",
             f"{ticks['per_s'] / 1e6:.1f} M ticks/s; {walks['per_s'] / 1e6:.1f} M steps/s"),
        ],
    )  # fmt: skip


@table
def first_minutes() -> str:
    """What a newcomer waits for."""
    found = load("benchmark_controller")
    return markdown(
        ("in the first ten minutes", "takes"),
        [
            *(
                (text, f"{found[key]:.0f} s")
                for text, key in (
                    ("`kjax doctor`: what is there and what is missing", "doctor_s"),
                    ("`kjax run trot_velocity`, the first time (22 s of walking; compiles)",
                     "first_run_s"),
                    ("again", "second_run_s"),
                    ("`--seeds 4`, 88 s of walking", "seeds_run_s"),
                    ("`kjax run bound_to_trot --video`, compiled and drawn", "switch_video_run_s"),
                    ("[your own loop](your_own_loop.md), from the import to the first torque",
                     "own_loop_first_s"),
                    ("the same from the compile cache", "own_loop_second_s"),
                )
            ),
            ("measured", recorded("benchmark_controller")),
        ],
    )  # fmt: skip


@table
def walks() -> str:
    """Gaits, rough ground and switches: both bases beside the paper."""
    got = Reproduced()

    def flat(name: str, base: str, form: str) -> str:
        rmse, pitch = (got.row(name, base, m) for m in ("velocity_rmse_mps", "pitch_p95_deg"))
        fell, of = got.count(name, base, "falls")
        return (f"{rmse['median']:{form}} ({rmse['worst']:{form}}), {fell} of {of} fell; "
                f"pitch 95 %: {pitch['median']:.2g}°")  # fmt: skip

    def field(name: str, base: str) -> str:
        crossed = got.row(name, base, "crossed")
        rmse, pitch = (got.row(name, base, m) for m in ("velocity_rmse_mps", "field_pitch_p95_deg"))
        done, of = got.count(name, base, "crossed")
        return (f"{done} of {of} crossed ({100 * crossed['low']:.1f} to "
                f"{100 * crossed['high']:.1f} %); RMSE {rmse['median']:.3f}; pitch 95 % in the "
                f"field {pitch['median']:.1f}° ({pitch['worst']:.1f}°)")  # fmt: skip

    def switch(name: str, base: str) -> str:
        peak, settle = (got.row(name, base, m) for m in ("switch_pitch_max_deg", "pitch_settle_s"))
        fell, of = got.count(name, base, "falls")
        return (f"{fell} of {of} fell; peak {peak['median']:.1f}° ({peak['worst']:.1f}°), settled "
                f"after {settle['median']:.2f} s ({settle['worst']:.2f} s)")  # fmt: skip

    lines = [
        ("trot steps, 6 x 1 ms: RMSE of v_x [m/s]", "0.029",
         lambda b: flat("trot_velocity", b, ".4f")),
        ("trot steps, 10 x 20 ms", "", lambda b: flat("trot_velocity_long", b, ".4f")),
        ("bound steps, the paper's timing", "0.189", lambda b: flat("bound_multiphase", b, ".3f")),
        ("the same within the stance (the paper's horizon)", "0.189",
         lambda b: flat("bound_velocity", b, ".3f")),
        ("bound steps, short flights", "", lambda b: flat("bound_multiphase_short", b, ".3f")),
        ("the same within the stance", "", lambda b: flat("bound_velocity_short", b, ".3f")),
        ("trot over the paper's field, 0.3 m/s", "one run, ±3° but for two slips",
         lambda b: field("trot_rough", b)),
        ("bound over it, 0.75 m/s", "one run", lambda b: field("bound_rough", b)),
        ("trot to bound at any time", "works", lambda b: switch("trot_to_bound", b)),
        ("bound to trot in flight", "smooth", lambda b: switch("bound_to_trot", b)),
        ("bound to trot in mid-stance (control)", "disturbs",
         lambda b: switch("bound_to_trot_naive", b)),
    ]  # fmt: skip
    header = ("16 seeds, 256 fields or 16 request times; median (worst)", "paper", *BASES)
    return markdown(header, [(name, paper, *map(of, BASES)) for name, paper, of in lines])


@table
def single_loop() -> str:
    """Times of the single robot's loop."""
    found = load("benchmark_controller")
    return markdown(
        ("one robot, one core", ""),
        [
            ("plan (lift, linear term, QP) and act [ms]",
             f"{found['plan_ms_median']:.3f} and {found['act_ms_median']:.3f}"),
            ("an empty jitted call [ms]", f"{found['noop_ms_median']:.3f}"),
            ("simulated over wall time, 1 kHz torque loop", f"{found['realtime_factor']:.1f}"),
            ("whole main job, first run with an empty compile cache, and second [s]",
             f"{found['first_run_s']:.0f} and {found['second_run_s']:.0f}"),
            ("recorded", recorded("benchmark_controller")),
        ],
    )  # fmt: skip


def _copied(name: str) -> Callable[[], str]:
    def copied() -> str:
        text = (RESULTS / name / "table.md").read_text(encoding="utf-8").strip()
        return f"Recorded {recorded(name)}.\n\n{text}\n"

    copied.__name__ = name
    return copied


for _name in ("benchmark_simulation", "benchmark_qp", "benchmark_edmd", "benchmark_gradient",
              "benchmark_device"):  # fmt: skip
    table(_copied(_name))


@table
def qp_box() -> str:
    """The box QPs of a walk, beside other solvers."""
    found = load("benchmark_qp")
    gaits = ("trot_velocity", "bound_velocity")
    box = {name: [found["box"][gait][name]["us_median"] for gait in gaits]
           for name in found["box"][gaits[0]]}  # fmt: skip
    batch = {name: [found["batch"][gait]["1024"][name] for gait in gaits]
             for name in ("kjax", "daqp loop")}  # fmt: skip

    def cells(*names: str) -> tuple[str, ...]:
        return tuple(" / ".join(f"{box[name][i]:.3g}" for name in names) for i in range(len(gaits)))

    return markdown(
        ("", "trot", "bound"),
        [
            ("kjax in a scan, warm", *cells("kjax in a scan, value")),
            ("the same with its gradient", *cells("kjax in a scan, value and gradient")),
            ("daqp, warm / cold", *cells("daqp, warm", "daqp, cold")),
            ("kjax, 1,024 at once, cold", *(f"{us:.3g}" for us in batch["kjax"])),
            ("daqp, a loop over 1,024", *(f"{us:.3g}" for us in batch["daqp loop"])),
            ("kjax, one call from Python, warm", *cells("kjax tableau, warm")),
            ("an empty jitted call with the same arguments", *cells("empty jitted call")),
            ("quadprog / OSQP 1e-6 / PIQP", *cells("quadprog", "OSQP 1e-6", "PIQP")),
            ("qpax / Clarabel", *cells("qpax", "Clarabel")),
        ],
    )


@table
def qp_rows() -> str:
    """QPs with rows, a new Hessian in every call."""
    rows = {name: f"{one['us_median']:.3g}" for name, one in load("benchmark_qp")["rows"].items()}
    pairs = (
        ("kjax active set / interior point", ("kjax active_set", "kjax interior_point")),
        ("daqp / ProxQP warm / PIQP", ("daqp, cold", "ProxQP, warm", "PIQP")),
    )
    return markdown(
        ("30 variables, 60 rows, H new in every call: bound through flight",
         "one call from Python"),
        [(text, " / ".join(rows[name] for name in names)) for text, names in pairs],
    )  # fmt: skip


@table
def roll_regulator() -> str:
    """Gains of the rough bound's roll regulator."""
    found = load("sweeps", "bound_rough_roll.json")

    def cell(i: int, j: int) -> str:
        share, low, high = (100 * found["success"][part][i][j] for part in ("value", "low", "high"))
        return f"{share:.0f} ({low:.0f} to {high:.0f})"

    damping = [f"damping {d:g} N m s/rad" for d in found["damping"]]
    return markdown(
        ("share that crosses [%]", *damping),
        [
            (f"stiffness {k:g} N m/rad", *(cell(i, j) for j in range(len(damping))))
            for i, k in enumerate(found["stiffness"])
        ],
    )


@table
def simulation() -> str:
    """Closed loops in batches beside the bare engines."""
    found = load("benchmark_simulation")

    def row(text: str, one: dict[str, float]) -> tuple[str, ...]:
        rates = (f"{one[name]:,.0f}" for name in ("robot_steps_per_s", "bare_robot_steps_per_s"))
        return text, *rates, f"{one['over_bare']:.2f}"

    names = {"held": "torques held", "every_step": "torques at every step"}
    rows = []
    for key, one in found["c"].items():
        gait, torques, robots = key.split(", ")
        rows.append(row(f"C, {gait}, {names[torques]}, {int(robots):,} robots", one))
    for robots, one in found["mjx"].items():
        rows.append(row(f"MJX in float32, trot, torques at every step, {int(robots):,}", one))
    alone = f"{found['python_loop']['robot_steps_per_s']:,.0f}"
    rows.append(("C, trot, one robot after the other in Python", alone, "", ""))
    return markdown(("robot-steps per second, two threads", "closed loop", "bare engine", ""), rows)


@table
def envelope() -> str:
    """How far the trots and the bound go, planar."""
    axes = load("envelope", "results.json")["axes"]
    gaits = ("trot", "flying_trot", "bound")

    def cell(quantity: str, gait: str) -> str:
        found = axes.get(f"{quantity}_{gait}_planar")
        if found is None:
            return ""
        if found["passed"] is None:
            return f"< {found['easy']:.3g}"
        text = f"{found['passed']:.3g}"
        if found["failed"] is None:
            text = f"{text}, the end of the search"
        if found.get("reached_mps") is not None:
            text += f" (reaches {found['reached_mps']:.3g})"
        return text

    return markdown(
        ("limit, 95 % of 20 seeds get through (planar)", "trot", "flying trot", "bound"),
        [
            (text, *(cell(quantity, gait) for gait in gaits))
            for quantity, text in (
                ("speed", "fastest [m/s]"),
                ("blocks", "highest blocks [m]"),
                ("push", "forward push at the weakest of seven phases [N s]"),
                ("friction", "slipperiest ground, friction [-]"),
            )
        ],
    )


def _as_left(name: str) -> Callable[[], str]:
    """The table of a study, as its command leaves it."""

    def left() -> str:
        return (RESULTS / name / "table.md").read_text(encoding="utf-8").strip() + "\n"

    left.__name__ = name
    return left


for _name in (
    "tune_trot",
    "tune_bound",
    "tune_omni",
    "learn_control",
    "spatial",
    "spatial_mjx",
    "spatial_models",
    "spatial_walks",
    "spatial_residual",
    "robots",
):
    table(_as_left(_name))


def two_digits(value: float) -> str:
    """A number to two digits, small ones with an exponent."""
    return f"{value:.1e}".replace("e-0", "e-") if value < 0.01 else f"{value:.2g}"


@table
def koopman_study() -> str:
    """Largest error of the velocity after 50 ms on the bound's ranges."""
    found = load("koopman_study")
    at = found["horizons_s"].index(0.05)
    errors = found["max_velocity_error_mps"]["bound ranges"]
    rows = [
        (name, *(two_digits(errors[stance][name][at]) for stance in ("trot", "front", "rear")))
        for name in errors["trot"]
    ]
    rows.sort(key=lambda row: -errors["trot"][row[0]][at])
    return markdown(("model", "trot [m/s]", "front [m/s]", "rear [m/s]"), rows)


@table
def model_walks() -> str:
    """Every model in closed loop, weights tuned alike."""
    walks = load("model_walks")["walks"]

    def cells(gait: str, model: str) -> tuple[str, ...]:
        if f"{gait}, {model}" not in walks:
            return ("-",) * 3
        found = walks[f"{gait}, {model}"]["tuned"]
        if found["falls"] == found["episodes"]:
            return ("-", "-", f"{found['falls']}")
        rmse = "{rmse_median:.4f} ({rmse_low:.4f} to {rmse_high:.4f})".format(**found)
        return rmse, f"{found['pitch_median']:.2g}", f"{found['falls']}"

    models = [one["model"] for one in walks.values() if one["gait"] == "trot"]
    return markdown(
        ("model in the LMPC", "trot: RMSE of v_x [m/s]", "pitch, 95 % [deg]", "fell, of 16",
         "bound: RMSE", "pitch", "fell"),
        [(model, *cells("trot", model), *cells("bound", model)) for model in models],
    )  # fmt: skip


@table
def whole_body() -> str:
    """Models as an LMPC uses them, against the whole robot inside a trot's stance."""
    models = load("whole_body")["families"]["trot"]

    def cells(model: str) -> tuple[str, ...]:
        parts = [models[model]["50ms"][what] for what in ("velocity", "omega")]
        return tuple(cell for one in parts for cell in (f"{one['rms']:.2g}", f"{one['ratio']:.2f}"))

    return markdown(
        ("inside a trot stance of the whole robot, 50 ms ahead", "velocity [m/s]", "ratio",
         "pitch rate [rad/s]", "ratio"),
        [(model, *cells(model)) for model in models],
    )  # fmt: skip


@table
def own_gaits() -> str:
    """Gaits that are data alone, on the free base."""
    rows = []
    for name, text in (
        ("pace", "pace, 0.2 s"),
        ("pronk", "pronk, 0.25 s, duty factor 0.6"),
        ("walk", "four-beat walk, 0.8 s, duty factor 0.75"),
    ):
        found = load(name, "seeds.json")
        cells = [
            "{median:.{n}f}, {worst:.{n}f}".format(
                n=digits, **{k: scale * found[metric][k] for k in ("median", "worst")}
            )
            for metric, digits, scale in (
                ("velocity_reference_rmse_mps", 3, 1.0),
                ("pitch_max_deg", 1, 1.0),
                ("roll_max_deg", 1, 1.0),
                ("foot_slip_m", 1, 1e3),
            )
        ]
        rows.append((text, *cells, f"{found['falls']} of {found['runs']}"))
    return markdown(
        ("gait (median, worst)", "RMSE, slewed reference [m/s]", "pitch, largest [deg]",
         "roll, largest [deg]", "foot slip per stance [mm]", "fell"),
        rows,
    )  # fmt: skip


@table
def reproduction() -> str:
    """The whole table of ``make reproduce``."""
    text = (RESULTS / "reproduce" / "table.md").read_text(encoding="utf-8").strip()
    return f"Recorded {recorded('reproduce', 'results.json')}.\n\n{text}\n"


def refreshed(text: str, page: str = "") -> str:
    """A page with its tables and quoted numbers as the results have them.

    Raises:
      ValueError: for a sentence of ``docs/quotes.py`` that the page does not have, or has twice.
    """
    text = BLOCK.sub(lambda found: found[1] + TABLES[found[2]]() + found[3], text)
    for quote in QUOTES.get(page, ()):
        text = _requoted(text, quote, page)
    return text


def _requoted(text: str, quote: str, page: str) -> str:
    for name, path in SHORT.items():
        quote = quote.replace(name, path)
    parts = PLACEHOLDER.split(quote)  # words, then path, factor, format, and words again
    words = [r"\s+".join(map(re.escape, re.split(r"\s+", part))) for part in parts[::4]]
    found = list(re.finditer(NUMBER.join(words), text))
    if len(found) != 1:
        raise ValueError(f"{page}: {len(found)} times, wanted once: {quote}")
    fields = zip(parts[1::4], parts[2::4], parts[3::4], strict=True)
    for group, field in reversed(list(enumerate(fields, start=1))):
        begin, end = found[0].span(group)
        text = text[:begin] + value(*field) + text[end:]
    return text


def value(path: str, factor: str | None, form: str) -> str:
    """A recorded value, by the folder and the keys that lead to it."""
    name, *keys = path.split("/")
    if name == "sweeps":
        file = f"{keys.pop(0)}.json"
    else:
        file = next(
            f
            for f in ("metrics.json", "results.json", "seeds.json")
            if (RESULTS / name / f).exists()
        )
    found = load(name, file)
    for key in keys:
        if key in ("min", "max"):
            found = {"min": min, "max": max}[key](_numbers(found))
        else:
            found = found[int(key)] if isinstance(found, list) else found[key]
    return f"{float(factor or 1) * found:{form}}"


def _numbers(nested: Any) -> list[float]:
    """All numbers of nested lists."""
    if isinstance(nested, list):
        return [number for one in nested for number in _numbers(one)]
    return [] if nested is None else [nested]


def conventions(path: Path) -> None:
    """Frames, signs and orders in one picture: side view, legs from above, phases of a gait."""
    import matplotlib.pyplot as plt
    import numpy as np

    fig, (side, top, clock) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    angle = 0.16
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    body = np.array([[0.28, 0.05], [0.28, -0.05], [-0.28, -0.05], [-0.28, 0.05]]) @ rotation.T
    side.fill(*(body + np.array([0.0, 0.3])).T, color="0.8", ec="0.3")
    side.axhline(0.0, color="0.4")
    side.plot(0.0, 0.3, "o", color="C3")
    side.annotate("centre of mass\n(p_x, p_z)", (0.0, 0.3), (-0.12, 0.42), ha="right",
                  arrowprops={"arrowstyle": "-", "color": "0.5"})  # fmt: skip
    for x, name in ((0.22, "front"), (-0.2, "rear")):
        side.annotate("", (x, 0.17), (x - 0.02, 0.0),
                      arrowprops={"arrowstyle": "-|>", "color": "C0", "lw": 2})  # fmt: skip
        side.text(x + 0.02, 0.06, f"F, {name}\n(on the robot)", color="C0", fontsize=8)
    bent = {"arrowstyle": "-|>", "color": "C3", "connectionstyle": "arc3,rad=.35"}
    side.annotate("", (0.42, 0.42), (0.42, 0.26), arrowprops=bent)
    side.text(0.47, 0.33, "θ, ω > 0:\nnose up", color="C3", fontsize=9)
    for (dx, dz), name in (((0.12, 0.0), "x: forward"), ((0.0, 0.12), "z: up")):
        side.annotate("", (-0.62 + dx, 0.05 + dz), (-0.62, 0.05), arrowprops={"arrowstyle": "->"})
        side.text(-0.6 + dx, 0.06 + dz, name, fontsize=8)
    side.set(xlim=(-0.7, 0.75), ylim=(-0.05, 0.55), aspect="equal", title="side view, world frame")
    side.axis("off")

    for i, (x, y, name) in enumerate(
        ((0.19, -0.13, "FR"), (0.19, 0.13, "FL"), (-0.19, -0.13, "RR"), (-0.19, 0.13, "RL"))
    ):
        top.plot(x, y, "o", ms=26, color="0.85", mec="0.3")
        top.text(x, y, f"{i}\n{name}", ha="center", va="center", fontsize=8)
    top.add_patch(plt.Rectangle((-0.24, -0.08), 0.48, 0.16, color="0.93", ec="0.3"))
    top.annotate("", (0.36, 0.0), (0.26, 0.0), arrowprops={"arrowstyle": "->"})
    top.text(0.37, 0.0, "x", va="center")
    top.annotate("", (0.0, 0.24), (0.0, 0.1), arrowprops={"arrowstyle": "->"})
    top.text(0.0, 0.25, "y: left", ha="center")
    top.text(0.0, 0.0, "joints of a leg:\nabduction, thigh, calf", ha="center", va="center",
             fontsize=8)  # fmt: skip
    top.set(xlim=(-0.35, 0.45), ylim=(-0.25, 0.32), aspect="equal", title="legs from above")
    top.axis("off")

    trot = {"FR": 0.0, "FL": 0.5, "RR": 0.5, "RL": 0.0}
    for row, offset in enumerate(reversed(trot.values())):
        for cycle in (-1, 0, 1):
            clock.barh(row, 0.5, left=cycle + offset, color="C0", height=0.6)
    clock.set(xlim=(0.0, 1.0), yticks=range(4), yticklabels=list(reversed(trot)))
    clock.set(
        xlabel="part of the cycle", title="trot: offset is touchdown,\nduty the stance (blue)"
    )
    fig.savefig(path, dpi=110)
    plt.close(fig)


def execute_notebooks(folder: Path) -> None:
    """The notebooks as executed ``.ipynb`` twins, for the site and for Jupyter."""
    import jupytext
    import nbformat
    from nbclient import NotebookClient

    folder.mkdir(exist_ok=True)
    for source in sorted((ROOT / "notebooks").glob("*.py")):
        notebook = jupytext.read(source)
        where = {"metadata": {"path": str(ROOT)}}
        NotebookClient(notebook, timeout=900, kernel_name="python3", resources=where).execute()
        for cell in notebook.cells:  # warnings and bars of progress are no results
            if cell.cell_type == "code":
                cell.outputs = [one for one in cell.outputs if one.get("name") != "stderr"]
        twin = folder / f"{source.stem}.ipynb"
        nbformat.write(notebook, twin)
        size = twin.stat().st_size
        print(f"{twin.name}: {size / 1000:.0f} kB", flush=True)
        if size > LIMIT:
            raise SystemExit(f"{twin.name}: wanted less than {LIMIT / 1000:g} kB")


def main() -> None:
    """Refresh all pages and pictures, and say which changed."""
    if "--notebooks" in sys.argv[1:]:
        execute_notebooks(ROOT / "docs" / "notebooks")
    for name in PAGES:
        page = ROOT / name
        before = page.read_text(encoding="utf-8")
        wanted = refreshed(before, name)
        if wanted != before:
            page.write_text(wanted, encoding="utf-8")
            print(f"{name}: tables written again")
    conventions(ROOT / "docs" / "images" / "conventions.png")


if __name__ == "__main__":
    main()
