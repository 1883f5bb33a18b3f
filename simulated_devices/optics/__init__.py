"""The optics: sources, phase screens, and the Fourier forward model."""
