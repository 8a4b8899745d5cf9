"""Where the camera is."""
