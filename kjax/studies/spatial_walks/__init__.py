"""What a better prediction in three dimensions buys in closed loop."""
