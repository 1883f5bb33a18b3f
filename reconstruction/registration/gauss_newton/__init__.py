"""Registration by Gauss-Newton steps, the reference's brightness conserved."""
