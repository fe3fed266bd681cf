"""What a rigid body misses of the whole robot, learned from recorded episodes."""
