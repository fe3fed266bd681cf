"""Which models predict the rigid body, how far, and how sure: every family beside the others.

    python experiments/koopman_study.py

``--help`` lists the options; the program is ``kjax.studies.koopman_study``.
"""

from kjax import cli
from kjax.studies.koopman_study import main

if __name__ == "__main__":
    cli.run(main)
