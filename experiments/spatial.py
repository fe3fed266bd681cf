"""The controller in three dimensions: what it follows, what it crosses, what it stands.

    python experiments/spatial.py

``--help`` lists the options; the program is ``kjax.studies.spatial.study``.
"""

from kjax import cli
from kjax.studies.spatial.study import main

if __name__ == "__main__":
    cli.run(main)
