"""Recordings in, bags in and out; no ROS installation needed."""
