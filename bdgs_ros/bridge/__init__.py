"""The only place that knows both ROS messages and core types."""
