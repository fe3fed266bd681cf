"""Derivatives of a closed loop: a rigid body on legs without mass under the controller."""
