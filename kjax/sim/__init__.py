"""Simulation: the scene, what the controller sees of it, and the engines' loops."""
