"""Fit the Koopman models of every contact mode and show how well they predict (Fig. 3).

    python experiments/koopman_fit.py configs/koopman_fit.toml

``--help`` lists the options; the program is ``kjax.studies.koopman_fit``.
"""

from kjax import cli
from kjax.studies.koopman_fit import main

if __name__ == "__main__":
    cli.run(main)
