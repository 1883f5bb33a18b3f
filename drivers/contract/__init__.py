"""Contract checks that every device must pass."""
