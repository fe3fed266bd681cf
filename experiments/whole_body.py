"""Learn what a rigid body misses of the whole robot, from its own closed-loop episodes.

    python experiments/whole_body.py

``--help`` lists the options; the program is ``kjax.studies.whole_body.study``.
"""

from kjax import cli
from kjax.studies.whole_body.study import main

if __name__ == "__main__":
    cli.run(main)
