"""Which models of the rigid body in three dimensions predict how far."""
