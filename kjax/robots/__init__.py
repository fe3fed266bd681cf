"""Robots: constants for the controller, and their MJCF; one module each."""

from kjax.robots.robot import Robot, get_robot, robot_names

__all__ = ["Robot", "get_robot", "robot_names"]
