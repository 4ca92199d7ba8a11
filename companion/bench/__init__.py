"""Benchmarks: one module of scenarios, rivals and timing for each part of the daemon."""
