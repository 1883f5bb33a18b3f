"""Camera noise: its model, and its measurement from the camera's own frames (photon transfer)."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from reconstruction.arrays import Floats, Image

_FEWEST_FRAMES = 4  # with fewer, a pixel's variance is too uncertain
_BINS = 40  # of light, with equally many pixels
_BEYOND = 1.05  # times the highest spatial frequency of the light
_FEWEST_FREQUENCIES = 0.1  # share of those beyond it
_MEDIAN_SQUARE = 0.4549  # of a normal deviate; hot pixels do not move it
_OUTLYING, _INNER_SQUARE = 9.0, 0.9733  # square that only hot pixels exceed, and the mean of normal deviates below it
_LEAST_NOISE = 2e-3  # of the light; noise-free images of lenslets seem to have 4e-4, from the borders of cells
_BRIGHT = 0.1  # of the brightest bin; dimmer ones tell little about shot noise
_TERMS = 2  # of a bent curve: proportional to light, and to its square
_CHANCE = 4.0  # standard errors below which a bend counts as noise


@dataclass(frozen=True, slots=True)
class CameraNoise:
    """Shot noise, amplified by the electron-multiplying register if there is one, and read noise."""

    counts_per_electron: float  # per photoelectron, including the register's gain
    read_noise_counts: float  # standard deviation of a dark pixel
    excess_noise: float = 1.0  # 1 ... 2, F^2, the register's factor on the variance of light

    @property
    def counts_per_light(self) -> float:
        """Shot-noise variance (counts^2) per count of light."""
        return self.excess_noise * self.counts_per_electron

    def variance(self, light: NDArray[np.floating[Any]]) -> Floats:
        """Variance (counts^2) of pixels with that light (counts above the dark), of the same shape."""
        return np.asarray(self.counts_per_light * np.maximum(light, 0.0) + self.read_noise_counts**2, np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class TransferCurve:
    """Variance of pixels against their light, in bins: a line if counts are proportional to light."""

    light: Floats  # counts, rising, (bin,)
    variance: Floats  # counts^2, (bin,)
    read_variance: float  # without light, counts^2
    relative_error: float = 0.0  # of each variance, at least

    @property
    def noise(self) -> CameraNoise | None:
        """Fit a line through the read noise, with equal relative errors; None with too little light."""
        light, variance = self._bright
        if not light.size or np.min(variance) <= self.read_variance:
            return None
        weight = 1 / variance**2
        slope = float(np.sum(weight * light * (variance - self.read_variance)) / np.sum(weight * light**2))
        return CameraNoise(counts_per_electron=slope, read_noise_counts=float(np.sqrt(self.read_variance)))

    @property
    def loss(self) -> float:
        """Share of the variance per count that is lost from dim to bright pixels, beyond chance; 0 for a line.

        Saturation or a gamma below 1 compress bright counts, and their noise more.
        """
        if self._bend is None:
            return 0.0
        bend, error = self._bend
        return float(np.clip(-(bend + _CHANCE * error) * np.max(self.light), 0, 1))

    def difference(self, other: "TransferCurve", averaged: float) -> float:
        """Share of the variance per count by which two images differ, beyond chance; 0 if unknown.

        A response that is not linear bends the line of variance against light (photon transfer, J. R. Janesick 2007),
        and images of the same response have the same bend. The other one is the mean of `averaged` frames. Uneven
        pixels bend both curves alike, the other one's up to `averaged` times as much, since their scatter stays.
        """
        mine, others = self._bend, other._bend  # noqa: SLF001 - of the same class
        if mine is None or others is None:
            return 0.0
        (here, error), (there, other_error) = mine, others
        least, most = sorted((there, there / averaged))
        beyond = here - min(max(here, least), most)
        brightest = min(np.max(self.light), np.max(other.light))
        return float(max(abs(beyond) - _CHANCE * math.hypot(error, other_error), 0.0) * brightest)

    @property
    def _bend(self) -> tuple[float, float] | None:
        """Relative change of the variance per count with light and its standard error, 1/count."""
        light, variance = self._bright
        if len(light) <= _TERMS or np.min(variance) <= self.read_variance:
            return None
        share = light / np.max(light)
        terms = np.stack([share, share**2], axis=-1) / variance[:, None]
        shot = 1 - self.read_variance / variance
        inverse = np.linalg.pinv(terms)
        slope, bend = inverse @ shot
        if slope <= 0:
            return None
        scatter = np.sum((shot - terms @ (slope, bend)) ** 2) / (len(terms) - _TERMS)
        scatter = max(scatter, self.relative_error**2)  # a few bins may agree by chance
        whole = slope * np.max(light)
        return float(bend / whole), float(math.sqrt(scatter * np.sum(inverse[1] ** 2)) / whole)

    @property
    def _bright(self) -> tuple[Floats, Floats]:
        bright = self.light > _BRIGHT * np.max(self.light)
        return self.light[bright], self.variance[bright]


@dataclass(frozen=True, slots=True)
class KnownNoise:
    """Noise of the camera, and what the reference shows of it."""

    of_frame: CameraNoise | None = None  # of a single frame; None if it is unknown
    reference_frames: float = math.inf  # averaged in the reference
    curve: TransferCurve | None = None  # variance of the reference's frames against their light


UNKNOWN_NOISE = KnownNoise()


def photon_transfer(mean: Image, variance: Image, *, frames: int, dark_variance: Image) -> TransferCurve | None:
    """Measure the noise of one frame from the variance of pixels against their light.

    None with too few frames. The photon-transfer method (J. R. Janesick, Photon Transfer, SPIE 2007): the slope is the
    counts per photoelectron times the excess noise, the variance without light is the read noise. Medians over bins of
    equal light, corrected for the chi-square distribution of sample variances, reject hot pixels.

    `mean` and `variance` (row, column) are those of each pixel over the `frames`, counts above the dark and counts^2;
    `dark_variance` is that without light.
    """
    if frames < _FEWEST_FRAMES:
        return None
    scatter = (1 - 2 / (9 * (frames - 1))) ** 3  # median over mean of chi-square (Wilson and Hilferty 1931)
    read_variance = float(np.median(dark_variance)) / scatter
    order = np.argsort(mean, axis=None)
    light = np.array([np.mean(part) for part in np.array_split(mean.ravel()[order], _BINS)])
    noise = np.array([np.median(part) for part in np.array_split(variance.ravel()[order], _BINS)]) / scatter
    return TransferCurve(light, noise, read_variance)


def beyond_optics(light: Image, blur_px: float) -> tuple[Image, float] | None:
    """Return the part of an image (row, column) that no optics shows, and its share of all spatial frequencies.

    The light of lenslets holds no spatial frequency, along x or y, above the inverse of the blur: the distance at which
    the image of a point first vanishes, wavelength times focal length over lenslet pitch. None if the pixels are too
    coarse.
    """
    rows, columns = light.shape
    cutoff = _BEYOND / blur_px  # cycles per pixel
    x, y = (np.arange(count) / (2 * count) > cutoff for count in (columns, rows))
    is_beyond = x | y[:, None]
    if (share := float(np.mean(is_beyond))) < _FEWEST_FREQUENCIES:
        return None
    return fft.idctn(fft.dctn(light, norm="ortho") * is_beyond, norm="ortho"), share


def image_transfer(light: Image, blur_px: float) -> TransferCurve | None:
    """Estimate the noise of one image (row, column), counts above the dark, from what no optics shows.

    There is only noise, which is white. None if the pixels are too coarse, or the image has hardly any noise.
    """
    if (found := beyond_optics(light.astype(np.float64), blur_px)) is None:
        return None
    noise, share = np.asarray(found[0], np.float64), found[1]
    smooth = ndimage.gaussian_filter(light.astype(np.float64), 1.0)  # as the filter spreads the noise
    order = np.argsort(smooth, axis=None)
    parts = np.array_split(order, _BINS)
    levels = np.array([np.mean(smooth.ravel()[part]) for part in parts])
    variance = np.array([_typical_square(noise.ravel()[part]) for part in parts]) / share
    if variance[-1] < (_LEAST_NOISE * levels[-1]) ** 2:
        return None
    darkest = int(np.argmin(variance))
    independent = share * light.size / _BINS  # pixels of a bin
    return TransferCurve(
        levels - levels[darkest],  # stray light is not read noise
        variance,
        float(variance[darkest]),
        relative_error=math.sqrt(2 / independent),
    )


def _typical_square(deviations: Floats) -> float:
    """Mean square of normal deviates (pixel,) without hot pixels; steadier than their median square."""
    squares = deviations**2
    median = np.median(squares) / _MEDIAN_SQUARE
    return float(np.mean(squares, where=squares <= _OUTLYING * median) / _INNER_SQUARE)
