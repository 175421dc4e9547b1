"""Benchmarks whose results are committed, under results/."""
