"""What the paper publishes, beside our results and targets."""
