"""Thin rclpy nodes: convert, call, publish."""
