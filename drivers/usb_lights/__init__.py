"""LED light sources on USB."""
