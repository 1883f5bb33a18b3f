"""Image quality of a wavefront, and how it varies over the field."""
