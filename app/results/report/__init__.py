"""PDF report of a recording: conditions, wavefronts and their uncertainty."""
