"""Camera frames: noise, bad pixels, and spline interpolation."""
