"""`svwfs layers`: where the aberration is."""
