"""EDMD beside pykoopman, pykoop and NumPy: fits, their data, a stream of snapshots."""
