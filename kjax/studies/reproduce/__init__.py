"""What the paper publishes, beside our numbers and targets."""
