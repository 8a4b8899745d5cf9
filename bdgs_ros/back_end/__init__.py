"""The back end: keyframes as a whole, bundle adjustment and loop closure."""
