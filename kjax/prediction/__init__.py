"""What an LMPC predicts with: rigid-body, Koopman, residual and learned models, one interface."""
