"""Registration by Gauss-Newton steps: the method of this instrument."""

from reconstruction.registration.gauss_newton._estimator import GaussNewton, prepare
from reconstruction.registration.gauss_newton._lenslet_fits import Propagated

__all__ = ["GaussNewton", "Propagated", "prepare"]
