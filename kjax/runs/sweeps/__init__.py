"""Sweeps: thousands of closed loops from one file, on disk as they end, resumable."""
