"""Long-running work: jobs, optimizers, networks, and the comparison of results."""
