"""What ``experiments/benchmark.py`` measures: medians, with a floor measured in the same run."""
