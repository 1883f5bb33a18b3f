"""The EMCCD detector: from photons to counts."""
