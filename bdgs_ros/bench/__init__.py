"""Benches: sequences x configurations x seeds, one harness for all figures."""
