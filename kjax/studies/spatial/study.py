"""The controller in three dimensions: what it follows, what it crosses, what it stands.

Commands: constant ones, errors from 2 s on. Random: v_x, v_y and yaw rate are drawn anew every 2
to 5 s, as raw steps. Grounds: slopes up, down and across, steps, tiles of random heights, unseen.
Pushes: 8 directions at 8 phases of a cycle. Speeds: of each gait, and of a turn on the spot.
Switches: trot, bound, trot at 64 phases. Laps: of a circle, the place fed back from outside, each
robot in a loop of its own in C. Paper: its profiles, and its field with any heading.

Leaves results.json, table.md and figure.png of these parts in the output folder. Every finished
batch is kept there: the same command goes on after Ctrl-C. A second of a robot takes about 0.1 s of
two cores, several times as much where rows are active: random walks and pushes take hours.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from kjax import cli
from kjax.config import RunConfig
from kjax.options import parse, require, require_names
from kjax.runs.batches import batch_key, run_batch
from kjax.runs.cache import Cache, open_cache
from kjax.studies.spatial import laps, measures
from kjax.studies.spatial.cases import NAMES, Done, Part, Row, SpatialOptions
from kjax.studies.spatial.commands import CONSTANT, RANDOM
from kjax.studies.spatial.grounds import GROUND, PAPER
from kjax.studies.spatial.laps import CIRCLE
from kjax.studies.spatial.limits import PUSHES, SPEED, SWITCHES
from kjax.studies.spatial.report import figure, table

PARTS: dict[str, Part] = {
    part.name: part for part in (CONSTANT, GROUND, RANDOM, PUSHES, SPEED, SWITCHES, CIRCLE, PAPER)
}


def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line, run what is missing, write table and figure; 0 if all was run."""
    args = parse(SpatialOptions, argv, __doc__.split("\n\n")[0])
    require_names(args, "parts", NAMES)
    require(args, "seeds", "robots", "threads", "chunk", least=1)
    if args.quick:
        args.seeds, args.robots = min(args.seeds, 2), min(args.robots, 2)
    folder = cli.output_folder(args, "spatial")
    cli.configure_jax(parallel=args.engine == "mjx")
    cache = open_cache(folder, Path(measures.__file__), Path(laps.__file__))
    how: dict[str, Any] = {"torques": "every_step", "dtype": np.float32, "engine": args.engine}
    record: Row = {"quick": args.quick, "engine": args.engine, "seeds": args.seeds, "parts": {}}
    asked = [PARTS[name] for name in NAMES if name in args.parts]
    try:
        for part in asked:
            _walk(part, args, cache, how)
            record["parts"][part.name] = part.summary(args, _reader(cache, part, how))
            print(part.table(record["parts"][part.name]), flush=True)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here")
        return 130
    text = table(record, PARTS)
    cli.save_study(folder, record, text, partial(figure, record), file="results.json")
    return 0


def _walk(part: Part, args: SpatialOptions, cache: Cache, how: dict[str, Any]) -> None:
    """What of a part is missing."""
    for label, configs in part.batches(args):
        run_batch(
            cache, configs, chunk=args.chunk, threads=args.threads, label=label,
            measure=part.measure, **how,
        )  # fmt: skip
    for config in tqdm(part.alone(args), desc=part.name, unit="episode", disable=None, leave=False):
        key = batch_key(cache, config, **how)
        if key not in cache:
            assert part.walk is not None
            cache.add({key: part.walk(config)})


def _reader(cache: Cache, part: Part, how: dict[str, Any]) -> Done:
    """Rows of configs that were walked."""

    def done(configs: list[RunConfig]) -> list[Row]:
        return [cache[batch_key(cache, c, measure=part.measure, **how)] for c in configs]

    return done
