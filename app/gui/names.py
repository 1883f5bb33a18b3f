"""Human names of the values of settings; in bench files they are words such as gauss_newton."""

from collections.abc import Mapping

from reconstruction.settings import Method, PupilBasis

_METHODS: Mapping[Method, str] = {
    "gauss_newton": "Gauss-Newton",
    "correlation": "correlation",
    "correlation_fft": "correlation (FFT)",
    "centroids": "centroids",
    "itk_affine": "affine (ITK)",
    "block_flow": "block flow",
    "demons": "demons",
    "ffd": "free-form (ITK)",
}
_BASES: Mapping[PupilBasis, str] = {"legendre": "Legendre", "zernike": "Zernike"}
NAMES: Mapping[str, str] = dict([*_METHODS.items(), *_BASES.items()])  # the others are their word
