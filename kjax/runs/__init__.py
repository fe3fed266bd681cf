"""Many episodes: workers, batches, sweeps; what is kept of them."""
