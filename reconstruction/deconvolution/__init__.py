"""Space-variant deconvolution: images without the measured aberration of their field position."""
