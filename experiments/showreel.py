"""The moving picture of the README: gaits and grounds, one after another.

    python experiments/showreel.py

``--help`` lists the options; the program is ``kjax.studies.showreel``.
"""

from kjax import cli
from kjax.studies.showreel import main

if __name__ == "__main__":
    cli.run(main)
