"""The QP solvers beside their peers, on the QPs of closed loops."""
