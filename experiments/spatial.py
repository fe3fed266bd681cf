"""The controller in three dimensions: commands, random walks, and grounds that it does not see.

    python experiments/spatial.py

``--help`` lists the options; the program is ``kjax.studies.spatial``.
"""

from kjax import cli
from kjax.studies.spatial import main

if __name__ == "__main__":
    cli.run(main)
