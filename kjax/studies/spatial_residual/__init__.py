"""What the rigid body in three dimensions misses of the whole robot; see ``study``."""
