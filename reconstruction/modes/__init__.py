"""Polynomials over the field and the pupil."""
