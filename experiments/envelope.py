"""Limits of each gait: speed, height of blocks, push, friction; goes on where it stopped.

    python experiments/envelope.py

``--help`` lists the options; the program is ``kjax.studies.envelope``.
"""

from kjax import cli
from kjax.studies.envelope import main

if __name__ == "__main__":
    cli.run(main)
