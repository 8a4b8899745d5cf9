"""Which Gaussians move: the heart of the paper."""
