"""Training, synthesis and benchmarks; not imported by the rest of the library."""
