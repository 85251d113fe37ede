"""Programs that try, check and measure the whole system: the demo, the validation, the benchmarks."""
