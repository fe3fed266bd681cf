"""All that the paper publishes beside our results; goes on where it stopped.

    python experiments/reproduce.py

``--help`` lists the options; the program is ``kjax.studies.reproduce.study``.
"""

from kjax import cli
from kjax.studies.reproduce.study import main

if __name__ == "__main__":
    cli.run(main)
