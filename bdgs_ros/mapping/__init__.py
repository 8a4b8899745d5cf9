"""The Gaussian map: rendering, growing and optimising it."""
