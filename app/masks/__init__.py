"""Masks as shapes with true edges, and drawings of them for a lithographer."""
