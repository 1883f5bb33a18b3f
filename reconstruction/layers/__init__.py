"""Layers of the sample: their distances and phase maps, from displacements and their covariance."""
