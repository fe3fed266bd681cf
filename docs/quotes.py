"""Sentences of the docs that quote results: what stands in braces comes from ``docs/results``.

Each is a piece of a page, with ``{FOLDER/KEY/KEY | FORMAT}`` for a number; the format may begin
with a factor, as in ``1e3 * .1f``, and the keys may end in ``min`` or ``max`` of a list.
``docs/refresh.py`` writes the numbers, a test compares them.
"""

SHORT = {
    "$trot": "whole_body/trot/inside, 50ms, ",
    "$bound": "whole_body/bound/inside, 50ms, ",
    "$starts": "whole_body/bound/all_starts, 50ms, all",
    "$edmd": "benchmark_edmd",
    "$qp": "benchmark_qp",
    "$learn": "learn_control",
    "$tuned": "tune_bound/mujoco",
    "$s/": "sweeps/",
    "$held": "reproduce/experiments/bound_rough",
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
    "docs/qp.md": (
        "{$qp/box/trot_velocity/empty jitted call/us_median | .0f} µs go into an empty one",
        "a warm call takes {$qp/size/400/kjax tableau, warm/us_median | 1e-3 * .1f} ms, a single "
        "Newton step of an interior point with a Riccati recursion "
        "{$qp/size/400/riccati, scan/us_median | 1e-3 * .1f} ms",
        "that step takes {$qp/size/400/riccati, associative/us_median | 1e-3 * .1f} ms here",
        "Of {$qp/random/solves | .0f} random warm-started box problems",
        "{$qp/random/wrong_solved | .0f} were called solved that were not, and "
        "{$qp/random/iteration_limit | .0f} ended at the iteration limit.",
        "{$qp/random_rows_wrong | .0f} were called solved, infeasible or unbounded that were not.",
        "agree with differences to {$qp/grad_rel_err_median | 1e12 * .0f}e-12 (median) and "
        "{$qp/grad_rel_err_max | 1e12 * .0f}e-12 (largest).",
        "of its 30 of the wheeled balancer {$qp/public/solved_1e9 | .0f} come out to 1e-9",
    ),
    "docs/sweeps.md": (
        "the pitch is {$s/bound_to_trot/switch_pitch_max_deg/value/0/max | .1f}° and settles in "
        "{$s/bound_to_trot/pitch_settle_s/value/0/max | .2f} s; at once it is "
        "{$s/bound_to_trot/switch_pitch_max_deg/value/1/min | .1f} to "
        "{$s/bound_to_trot/switch_pitch_max_deg/value/1/max | .1f}°, and settles in "
        "{$s/bound_to_trot/pitch_settle_s/value/1/min | .2f} to "
        "{$s/bound_to_trot/pitch_settle_s/value/1/max | .2f} s.",
        "at 0.6 and 0.8 m/s in {$s/trot_rough/success/value/3/2 | 100 * .0f} and "
        "{$s/trot_rough/success/value/4/2 | 100 * .0f} %;",
        "the paper's field {$s/trot_rough_1024/episodes_per_point | .0f} times: "
        "{$s/trot_rough_1024/success/value/0 | 1024 * .0f} cross",
        "20 N s at four of them ({$s/push_bound/success/value/3/3 | 100 * .0f}, "
        "{$s/push_bound/success/value/3/2 | 100 * .0f} and "
        "{$s/push_bound/success/value/3/5 | 100 * .0f} % succeed at the others)",
        "at 8 cm {$s/bound_rough/success/value/0/2 | 100 * .0f} % at 0.3 m/s and "
        "{$s/bound_rough/success/value/1/2 | 100 * .0f} to "
        "{$s/bound_rough/success/value/3/2 | 100 * .0f} % faster;",
        "Pitch grows from {$s/bound_rough/field_pitch_p95_deg/value/min | .0f} to "
        "{$s/bound_rough/field_pitch_p95_deg/value/max | .0f}°.",
        "{$s/bound_timing/success/value/0/1 | 100 * .0f} % at 0.35 s and all at 0.4 s, with "
        "{$s/bound_timing/pitch_p95_deg/value/0/2 | .0f}° to "
        "{$s/bound_timing/pitch_p95_deg/value/0/1 | .0f}° of pitch. Short cycles pitch less: "
        "{$s/bound_timing/pitch_p95_deg/value/3/0 | .1f}° at 0.35 x 0.3 s, "
        "{$s/bound_timing/pitch_p95_deg/value/1/2 | .0f}° at 0.25 x 0.4 s.",
        "costs height ({$s/model_error/height_error_mean_m/value/5/0 | 1e3 * .0f} mm at 6 kg)",
        "(off by {$s/model_inertia/height_error_mean_m/value/0/2 | 1e3 * .0f} and "
        "{$s/model_inertia/height_error_mean_m/value/4/2 | 1e3 * .0f} mm at both ends",
    ),
    "docs/results.md": (
        "{$held/planar/held/cost/crossed/difference | -100 * .1f} % of the fields on the planar "
        "base (an interval of {$held/planar/held/cost/crossed/high | -100 * .1f} to "
        "{$held/planar/held/cost/crossed/low | -100 * .1f} %) and "
        "{$held/free/held/cost/crossed/difference | -100 * .1f} % "
        "({$held/free/held/cost/crossed/high | -100 * .1f} to "
        "{$held/free/held/cost/crossed/low | -100 * .1f} %) on the free one: "
        "{$held/free/held/cost/crossed/held | .0f} of 256 crossed.",
        "({$held/free/summary/velocity_reference_rmse_mps/median | .3f} and "
        "{$held/planar/summary/velocity_reference_rmse_mps/median | .3f} against the slewed "
        "reference)",
        "The roll reaches {$s/bound_rough_roll/roll_max_deg/value/min | .0f} to "
        "{$s/bound_rough_roll/roll_max_deg/value/max | .0f}°",
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
