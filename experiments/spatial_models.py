"""Which models of the rigid body in three dimensions predict how far: attitude and its rate.

    python experiments/spatial_models.py

``--help`` lists the options; the program is ``kjax.studies.spatial_models.study``.
"""

from kjax import cli
from kjax.studies.spatial_models.study import main

if __name__ == "__main__":
    cli.run(main)
