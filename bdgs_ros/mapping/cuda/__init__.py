"""The map on an NVIDIA card: rasteriser, parameters and optimisation that never leave it."""
