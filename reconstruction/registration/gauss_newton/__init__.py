"""Registration by flux-conserving Gauss-Newton steps."""
