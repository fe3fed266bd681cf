"""Robots: constants for the controller, and their MJCF."""
