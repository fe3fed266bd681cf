"""Legs: kinematics, swing and stance."""
