"""Registration by Gauss-Newton steps: the method of this instrument."""

from reconstruction.registration.gauss_newton._estimator import GaussNewton, prepare

__all__ = ["GaussNewton", "prepare"]
