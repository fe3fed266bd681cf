"""Jumps of the velocity command: falls, body contacts and pitch after each.

    python experiments/raw_steps.py

``--help`` lists the options; the program is ``kjax.studies.raw_steps``.
"""

from kjax import cli
from kjax.studies.raw_steps import main

if __name__ == "__main__":
    cli.run(main)
