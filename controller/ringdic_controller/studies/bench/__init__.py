"""Benchmarks of the whole system on this machine: captures, whole jobs, live steps."""
