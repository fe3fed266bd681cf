"""Command line, output folders and provenance of the experiments."""
