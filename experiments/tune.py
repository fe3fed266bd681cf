"""Tune the controller by gradients through its closed loop, then see what MuJoCo says.

    python experiments/tune.py configs/trot_velocity_long.toml

``--help`` lists the options; the program is ``kjax.studies.tune.study``.
"""

from kjax import cli
from kjax.studies.tune.study import main

if __name__ == "__main__":
    cli.run(main)
