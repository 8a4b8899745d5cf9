"""Types, geometry, configuration and errors: no ROS, no files, no clock."""
