"""What do robots of other sizes do with the config of the Go1?

    python experiments/robots.py

``--help`` lists the options; the program is ``kjax.studies.robots.study``.
"""

from kjax import cli
from kjax.studies.robots.study import main

if __name__ == "__main__":
    cli.run(main)
