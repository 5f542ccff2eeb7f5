"""Benchmarks that users run: kernel times on their machine."""
