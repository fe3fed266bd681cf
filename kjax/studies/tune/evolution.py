"""CMA-ES (pycma) on a cost of whole populations, kept after every generation."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from kjax.runs.cache import Cache

SIGMA = 0.5  # of a first population, about a factor of 1.6 where variables are logs


class Evolution(NamedTuple):
    """What a search has found, of n variables.

    Attributes:
      favourite: (n,) mean of the last generation's distribution.
      best: (n,) the candidate that cost least.
      costs: (G, P) of every candidate.
      seconds: (G,) wall time of every generation.
      population: P.
    """

    favourite: Float[np.ndarray, "n"]
    best: Float[np.ndarray, "n"]
    costs: Float[np.ndarray, "G P"]
    seconds: Float[np.ndarray, "G"]
    population: int


def evolve(
    cost: Callable[[Sequence[np.ndarray]], np.ndarray],
    mean: Float[np.ndarray, "n"],
    *,
    cache: Cache,
    key: str,
    seconds: float = np.inf,
    generations: int | None = None,
    population: int | None = None,
    with_mean: bool = False,
    label: str = "CMA-ES",
) -> Evolution:
    """Search from a point for some wall time or some generations.

    What is kept is the costs and times of the generations: the search draws the same candidates
    from the same seed, and is told again what they cost.

    Args:
      cost: (P,) of P candidates.
      mean: of the first generation.
      cache: that generations are kept in,
      key: under this one.
      seconds: wall time after which no generation begins; interrupted runs count together.
      generations: number of them, at most.
      population: candidates of a generation; what pycma takes for n variables if ``None``.
      with_mean: whether the first candidate is ``mean`` itself.
      label: of the progress bar.

    Raises:
      KeyboardInterrupt: as ``cost`` does; finished generations are kept.
    """
    import cma

    options = {"seed": 1, "verbose": -9} | ({"popsize": population} if population else {})
    search = cma.CMAEvolutionStrategy(mean, SIGMA, options)
    if with_mean:
        search.inject([mean], force=True)
    asked: list[np.ndarray] = []
    costs: list[np.ndarray] = []
    spent: list[float] = []
    kept = cache.arrays(key)
    if kept is not None:
        known = zip(kept["costs"][:generations], kept["seconds"][:generations], strict=True)
        for row, seconds_of_it in known:
            candidates = search.ask()
            search.tell(candidates, row.tolist())
            asked += candidates
            costs.append(row)
            spent.append(float(seconds_of_it))
    limit = np.inf if generations is None else generations
    total, unit = (round(seconds), "s") if generations is None else (generations, "generation")
    with tqdm(total=total, unit=unit, desc=label, disable=None, leave=False) as bar:
        bar.n = min(total, len(costs) if generations is not None else round(sum(spent)))
        while len(costs) < limit and sum(spent) < seconds and not search.stop():
            clock = time.perf_counter()
            candidates = search.ask()
            row = cost(candidates)
            search.tell(candidates, row.tolist())
            asked += candidates
            costs.append(row)
            spent.append(time.perf_counter() - clock)
            cache.add_arrays(key, {"costs": np.stack(costs), "seconds": np.array(spent)})
            bar.n = min(total, len(costs) if generations is not None else round(sum(spent)))
            bar.set_postfix_str(f"cost {min(one.min() for one in costs):.3f}")
    if not costs:
        return Evolution(mean, mean, np.zeros((0, search.popsize)), np.zeros(0), search.popsize)
    table = np.stack(costs)
    return Evolution(
        favourite=search.result.xfavorite,
        best=np.asarray(asked[int(np.argmin(table))]),
        costs=table,
        seconds=np.array(spent),
        population=search.popsize,
    )
