"""Sentences of the docs that quote results: what stands in braces comes from ``docs/results``.

Each is a piece of a page, with ``{FOLDER/KEY/KEY | FORMAT}`` for a number; the format may begin
with a factor, as in ``1e3 * .1f``. ``docs/refresh.py`` writes the numbers, a test compares them.
"""

SHORT = {
    "$trot": "whole_body/trot/inside, 50ms, ",
    "$bound": "whole_body/bound/inside, 50ms, ",
    "$starts": "whole_body/bound/all_starts, 50ms, all",
    "$edmd": "benchmark_edmd",
    "$learn": "learn_control",
    "$tuned": "tune_bound/mujoco",
}

QUOTES: dict[str, tuple[str, ...]] = {
    "docs/models.md": (
        "`docs/results/benchmark_edmd/`): {$edmd/fits/fit_ms/kjax | .1f} ms from states to model, "
        "pykoopman {$edmd/fits/fit_ms/pykoopman | .1f}, pykoop {$edmd/fits/fit_ms/pykoop | .0f}",
        "in one call {$edmd/fits/many_s/kjax | 1e3 * .0f} ms, pykoopman's loop "
        "{$edmd/fits/many_s/pykoopman | .2f} s, pykoop's {$edmd/fits/many_s/pykoop | .1f} s.",
        "equations are faster ({$edmd/fits/regression_ms/pykoopman | .1f} ms against "
        "{$edmd/fits/regression_ms/kjax | .1f})",
        "are drawn {$edmd/rollouts_speedup | .0f} times as fast as by a loop in NumPy, and "
        "{$edmd/rollouts_over_vectorised_numpy | .2f} times as fast as by NumPy vectorised",
        "stream through {$edmd/stream/peak_MB | .0f} MB.",
        "with {$trotall/affine/0/0 | .2f} of the rigid body's velocity error and "
        "{$trotall/affine/1/0 | .2f} of its pitch-rate error",
        "as inputs {$trotall/clock_history/0/0 | .2f} ({$trotall/clock_history/0/1 | .2f} to "
        "{$trotall/clock_history/0/2 | .2f}) and {$trotall/clock_history/1/0 | .2f} "
        "({$trotall/clock_history/1/1 | .2f} to {$trotall/clock_history/1/2 | .2f}); in a bound's "
        "stance {$boundall/clock_history/0/0 | .2f} and {$boundall/clock_history/1/0 | .2f}.",
        "On flat ground alone it is {$trotflat/clock_history/0/0 | .2f} and "
        "{$trotflat/clock_history/1/0 | .2f}; on blocks {$trotrough/clock_history/0/0 | .2f} of "
        "the velocity's error, where feet slip; without the stances in which a foot slips "
        "{$trotall, no foot slips/clock_history/0/0 | .2f}.",
        "cuts a bound's velocity error from {$starts/frozen nominal, rms/0 | .2f} to "
        "{$starts/scheduled nominal, rms/0 | .3f} m/s before anything is learned, and to "
        "{$starts, against the frozen nominal/scheduled touchdown/0/0 | .2f} of it with a residual",
        "during pushes (with them {$trotall, during pushes as well/clock_history/0/0 | .2f} for",
    ),
    "docs/tuning.md": (
        "Median ratio {benchmark_gradient/grad_over_value | .1f};",
        "the closed loop costs {$learn/cost_ratio | .2f} ({$learn/cost_ratio_low | .2f} to "
        "{$learn/cost_ratio_high | .2f}) of what the other does",
        "rears once, to {$tuned/gradient/pitch_max_deg/median | .0f}° (CMA-ES "
        "{$tuned/CMA-ES/pitch_max_deg/median | .0f}°, the hand's "
        "{$tuned/own/pitch_max_deg/median | .0f}°)",
    ),
}
