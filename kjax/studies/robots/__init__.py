"""One config, many robots; see ``study``."""
