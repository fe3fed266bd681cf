"""Derivatives of a closed loop: a rigid body on legs without mass, walked by the controller."""
