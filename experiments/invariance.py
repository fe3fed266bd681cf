"""Whether the closed loop depends on where the origin lies: start, floor and heading varied.

    python experiments/invariance.py

``--help`` lists the options; the program is ``kjax.studies.invariance``.
"""

from kjax import cli
from kjax.studies.invariance import main

if __name__ == "__main__":
    cli.run(main)
