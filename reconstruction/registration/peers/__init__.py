"""Registration methods from the literature, for comparison."""
