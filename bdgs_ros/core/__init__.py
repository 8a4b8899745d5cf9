"""Types, geometry, configuration, errors, writing aside: no ROS, no formats, no clock."""
