"""Registration by Gauss-Newton steps: the method of this instrument."""

from reconstruction.registration.gauss_newton._estimator import GaussNewton, prepare
from reconstruction.registration.gauss_newton._lenslet_fits import Propagated
from reconstruction.registration.gauss_newton._template import SteepestDescent, coefficient_covariance, prepare_template

__all__ = ["GaussNewton", "Propagated", "SteepestDescent", "coefficient_covariance", "prepare", "prepare_template"]
