"""Metrics of trajectories and images, and reports."""
