"""From displacements to the wavefront: zonal and modal."""
