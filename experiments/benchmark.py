"""Benchmarks beside floors and peers: controller, qp, simulation, edmd, gradient.

    python experiments/benchmark.py controller

``--help`` lists the options; the program is ``kjax.bench.main``.
"""

from kjax import cli
from kjax.bench.main import main

if __name__ == "__main__":
    cli.run(main)
