"""What pyrcal costs, measured here and beside its peers: ``python -m benchmarks.bench --help``."""
