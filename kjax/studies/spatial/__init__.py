"""The controller in three dimensions: what it is asked, what it does, what it stands."""
