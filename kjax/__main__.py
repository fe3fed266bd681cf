"""``python -m kjax``: the command ``kjax`` where its script is not on the path."""

from kjax.commands.main import start

if __name__ == "__main__":
    start()
