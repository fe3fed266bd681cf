"""What a benchmark says of the machine: its cores, their gain, the memory of this process."""

import os
import resource
import subprocess
import sys

import numpy as np

from kjax.bench.timing import elapsed


def cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


def peak_memory() -> float:
    """Largest resident memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def two_process_speedup() -> float:
    """What two processes that share nothing gain over one: the most that can be had here [-]."""
    code = "x = 0\nfor i in range(20_000_000): x += i * i"

    def once(count: int) -> None:
        running = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(count)]
        for process in running:
            process.wait()

    return float(np.median([2.0 * elapsed(once, 1) / elapsed(once, 2) for _ in range(3)]))
