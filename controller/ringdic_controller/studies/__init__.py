"""What proves the system: the demo, the validation, the benchmarks."""
