"""Rigid bodies: formulas, no learning."""
