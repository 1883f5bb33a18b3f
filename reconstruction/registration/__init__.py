"""Registration: displacement of each subimage relative to the reference."""
