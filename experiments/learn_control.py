"""A lifting learned for control: prediction loss plus closed-loop cost through the QP.

    python experiments/learn_control.py

``--help`` lists the options; the program is ``kjax.studies.learn_control``.
"""

from kjax import cli
from kjax.studies.learn_control import main

if __name__ == "__main__":
    cli.run(main)
