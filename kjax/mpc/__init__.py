"""Linear model predictive control on Koopman models."""
