"""Studies of the estimator and of the routines, for `svwfs study`."""
