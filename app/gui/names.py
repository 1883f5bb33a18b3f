"""Human names of the values of settings; in bench files they are words such as gauss_newton."""

from collections.abc import Mapping

NAMES: Mapping[str, str] = {  # the others are their word
    "gauss_newton": "Gauss-Newton",
    "correlation_fft": "correlation (FFT)",
    "itk_affine": "affine (ITK)",
    "legendre": "Legendre",
    "zernike": "Zernike",
}
