"""What benchmark.py qp tabulates and draws."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from kjax.viz.style import figure_style
from kjax.viz.tables import markdown_table


def table(result: dict[str, Any]) -> str:
    """All of it as Markdown."""
    trot, bound = result["box"]["trot_velocity"], result["box"]["bound_velocity"]
    single = markdown_table(
        ("single call from Python, 24 variables", "trot [us]", "bound [us]",
         "largest force error [N]"),
        (
            (name, f"{entry['us_median']:.1f}", f"{bound[name]['us_median']:.1f}",
             f"{max(e.get('force_error_max_N', 0.0) for e in (entry, bound[name])):.1e}")
            for name, entry in trot.items()
        ),
    )  # fmt: skip
    batch = markdown_table(
        ("batch", *result["batch"]["trot_velocity"]),
        (
            (f"{gait}, {solver}, us per problem", *(f"{e[solver]:.1f}" for e in batches.values()))
            for gait, batches in result["batch"].items()
            for solver in next(iter(batches.values()))
        ),
    )
    rows = markdown_table(
        ("rows: bound with a horizon through flight, 30 variables", "us",
         "apart from active_set [N]"),
        (
            (name, f"{e['us_median']:.0f}", f"{e['apart_from_active_set_max_N']:.1e}")
            for name, e in result["rows"].items()
        ),
    )  # fmt: skip
    checks = result["random"]
    lines = [
        single,
        batch,
        rows,
        f"{checks['solves']:,} random solves, warm-started: {checks['wrong_solved']} wrong, "
        f"{checks['iteration_limit']} at the iteration limit, {checks['other_status']} refused.",
    ]
    for name, entry in result["gradient"].items():
        lines.append(
            f"Gradient against differences, {name}: median {entry['median']:.0e}, "
            f"max {entry['max']:.0e} of {entry['problems']} problems."
        )
    if "public" in result:
        entry = result["public"]
        lines.append(
            f"Public problems: {entry['solved_1e9']} of {entry['problems']} to 1e-9, "
            f"{entry['over_daqp_median']:.1f} times daqp's time (median)."
        )
    return "\n".join(lines) + "\n"


@figure_style
def figure(result: dict[str, Any], path: Path) -> None:
    """Cost against the number of variables, and against the batch."""
    fig, (left, right) = plt.subplots(1, 2, figsize=(12, 4), layout="constrained")
    sizes = sorted(int(k) for k in result["size"])
    by_size = {int(k): v for k, v in result["size"].items()}
    names = dict.fromkeys(n for s in sizes for n in by_size[s] if "in a scan" not in n)
    for name in names:
        if name == "empty jitted call":
            continue
        ours, step = name.startswith("kjax"), name.startswith("riccati")
        there = [n for n in sizes if name in by_size[n]]
        left.loglog(
            there,
            [by_size[n][name]["us_median"] for n in there],
            "o-" if ours else ".--" if step else ".-",
            lw=2.5 if ours else 1.0,
            label=f"one step of: {name}" if step else name,
        )
    left.set(xlabel="variables", ylabel="single call from Python [us]")
    left.set(title="Single calls against the horizon (QPs of the trot)")
    left.set_xticks(sizes, [str(n) for n in sizes])
    left.minorticks_off()
    left.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    for color, (gait, batches) in zip(("C0", "C1"), result["batch"].items(), strict=True):
        counts = [int(k) for k in batches]
        for solver, style in (("kjax", "o-"), ("daqp loop", "--")):
            if solver in next(iter(batches.values())):
                values = [entry[solver] for entry in batches.values()]
                label = f"{gait.split('_')[0]}, {solver}"
                right.loglog(counts, values, style, color=color, label=label)
    right.set(xlabel="batch", ylabel="us per problem")
    right.set(title=_batch_title(result["batch"]))
    right.legend()
    fig.savefig(path)
    plt.close(fig)


def _batch_title(batches: dict[str, Any]) -> str:
    """From how many problems on a batch is faster than daqp's loop, for every gait."""
    rows = [
        {int(k): v["kjax"] < v["daqp loop"] for k, v in one.items() if "daqp loop" in v}
        for one in batches.values()
    ]
    counts = sorted(set.intersection(*map(set, rows)))
    wins = [n for n in counts if all(row[m] for row in rows for m in counts if m >= n)]
    what = f"From {wins[0]} problems on a batch beats a loop in C" if wins else "Cost in a batch"
    return f"{what} (24 variables, cold, one thread)"
