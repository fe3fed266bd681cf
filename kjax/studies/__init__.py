"""What the scripts in ``experiments/`` run: single runs, sweeps, and one study a file or folder."""
