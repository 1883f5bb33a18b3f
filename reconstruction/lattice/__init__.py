"""Search for the lattice of lenslets in a reference frame."""
