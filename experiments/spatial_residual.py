"""What does the rigid body in three dimensions miss of the whole robot?

    python experiments/spatial_residual.py

``--help`` lists the options; the program is ``kjax.studies.spatial_residual.study``.
"""

from kjax import cli
from kjax.studies.spatial_residual.study import main

if __name__ == "__main__":
    cli.run(main)
