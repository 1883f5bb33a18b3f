"""Recordings once more through the pipeline: the same to the last bit, or with another bench for comparison."""
