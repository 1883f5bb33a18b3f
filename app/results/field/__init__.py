"""`svwfs field`: coefficients over the field."""
