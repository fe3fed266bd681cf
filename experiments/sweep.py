"""Run a whole sweep of closed loops: a grid or a random sample of configs, times seeds.

    python experiments/sweep.py configs/sweeps/trot_rough.toml

``--help`` lists the options; the program is ``kjax.studies.sweep``.
"""

from kjax import cli
from kjax.studies.sweep import main

if __name__ == "__main__":
    cli.run(main)
