"""The controller: from a config to parameters, and the pure functions that plan and act."""
