"""Models from recordings of the whole robot."""
