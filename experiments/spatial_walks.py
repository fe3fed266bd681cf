"""Is a better prediction better in closed loop, in three dimensions? Every model, tuned alike.

    python experiments/spatial_walks.py

``--help`` lists the options; the program is ``kjax.studies.spatial_walks.study``.
"""

from kjax import cli
from kjax.studies.spatial_walks.study import main

if __name__ == "__main__":
    cli.run(main)
