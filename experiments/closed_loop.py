"""Run the robot under the Koopman LMPC in MuJoCo: one run, or one per seed.

    python experiments/closed_loop.py configs/trot_velocity.toml

``--help`` lists the options; the program is ``kjax.studies.closed_loop``.
"""

from kjax import cli
from kjax.studies.closed_loop import main

if __name__ == "__main__":
    cli.run(main)
