"""What the estimator leaves of the truth, against everything that may be hard for it: `svwfs study`."""
