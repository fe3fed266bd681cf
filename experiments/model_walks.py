"""Every prediction model in closed loop, each with its weights tuned alike.

    python experiments/model_walks.py

``--help`` lists the options; the program is ``kjax.studies.model_walks``.
"""

from kjax import cli
from kjax.studies.model_walks import main

if __name__ == "__main__":
    cli.run(main)
