"""One measurement: calibration, routines, refinement, and the result for one frame."""
