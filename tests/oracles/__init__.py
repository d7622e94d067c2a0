"""What tests and benchmarks judge by: models, simulations
and searches of their own."""
