"""Closed loops per second of both engines, beside the bare engines."""
