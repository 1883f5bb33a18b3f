"""Displacements of the subimages from the reference, the result of every registration method."""

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.modes.field_modes import FieldModes, LegendreModes
from reconstruction.runtime.deferred import Deferred

# Error of each coefficient without noise, taken as uncorrelated. On the screens of evidence/accuracy.md it is 0.001 px
# and correlated along rows of lenslets; with 0.002 to 0.004 the residuals were least.
SYSTEMATIC_PX = 0.0025

LensletStatuses = NDArray[np.int8]  # an `LensletStatus` for every lenslet


class LensletStatus(IntEnum):
    """Result of the registration of a lenslet; only CONVERGED yields a slope."""

    CONVERGED = 0
    DARK = 1  # without light in the frame, or on bad pixels
    SATURATED = 2
    DIVERGED = 3
    LEFT_CELL = 4  # beyond the dynamic range: the subimage reaches into the neighbour's cell
    ABSENT = 5  # without an image in the reference: outside the pupil or off the frame
    EXCLUDED = 6  # by hand

    @property
    def reason(self) -> str:
        """Why the lenslet is lost, in the words of every table, window and report; empty if it converged."""
        return _REASONS[self]


_REASONS = {
    LensletStatus.CONVERGED: "",
    LensletStatus.DARK: "no light",
    LensletStatus.SATURATED: "saturated",
    LensletStatus.DIVERGED: "no match with the reference",
    LensletStatus.LEFT_CELL: "left its cell",
    LensletStatus.ABSENT: "outside the pupil, or without an image in the reference",
    LensletStatus.EXCLUDED: "excluded by hand",
}


class CovarianceSource(Protocol):
    """A covariance that is computed when it is first needed; NaN where not converged."""

    def kept(self, lenslets: Booleans) -> Self:
        """The same, lost for all but some lenslets (L,)."""
        ...

    def __call__(self) -> Floats:
        """The covariance, px^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)."""
        ...

    def trace(self) -> Floats:
        """Sum of the variances, px^2, (lenslet_row, lenslet_column)."""
        ...


TRANSMISSION_MODES = LegendreModes(6)  # constant, linear and quadratic over the field, also a circular one
LINEAR_TERMS = 3  # of which the constant and the linear ones are no displacement of any sample


@dataclass(frozen=True, slots=True, eq=False)
class Transmission:
    """Brightness of the frame's subimages over that of the reference's, quadratic over the field.

    Rays keep their brightness, so that it is what the sample lets through, and not how it gathers light.
    """

    coefficients: Floats  # of `TRANSMISSION_MODES`, (lenslet_row, lenslet_column, 6); NaN where unknown
    covariance: Floats  # (lenslet_row, lenslet_column, 6, 6), of the camera's noise

    def at(self, modes: Floats) -> tuple[Floats, Floats]:
        """Values and standard errors for values of the modes (..., 6), each (..., lenslet_row, lenslet_column)."""
        variance = np.einsum("...i,rcij,...j->...rc", modes, self.covariance, modes)
        return np.einsum("...i,rci->...rc", modes, self.coefficients), np.sqrt(variance)


@dataclass(frozen=True, eq=False)
class Displacement:
    """Displacements of all subimages of a frame from the reference."""

    modes: FieldModes  # T_q
    coefficients: Floats  # c_q, px, (lenslet_row, lenslet_column, field_mode, xy); NaN where not converged
    covariance_source: Floats | CovarianceSource | Deferred[Floats]  # `covariance`, or what computes it
    outcome: LensletStatuses  # (lenslet_row, lenslet_column)
    residual_rms: Floats  # misfit over the contrast of the reference's best subimage; NaN where not converged
    chi_square: Floats  # reduced; NaN where not converged and where the camera's noise is unknown
    range_used: Floats  # share of the dynamic range used by the field's edge; above 1 only where LEFT_CELL
    transmission_source: Transmission | Deferred[Transmission | None] | None = (
        None  # None: the method does not measure it
    )
    absorbs: bool = False  # whether as much brightness was taken out as behind a sample that absorbs

    @property
    def covariance(self) -> Floats:
        """px^2, (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy); NaN where not converged."""
        found: Floats | None = vars(self).get("_covariance")  # no cached property: see `Deferred`
        if found is None:
            source = self.covariance_source
            found = vars(self)["_covariance"] = source if isinstance(source, np.ndarray) else source()
        return found

    @property
    def transmission(self) -> Transmission | None:
        """Share of the light that the sample lets through; None if the method does not measure it."""
        source = self.transmission_source
        return source() if isinstance(source, Deferred) else source

    @cached_property
    def valid(self) -> Booleans:
        """True for converged lenslets, (lenslet_row, lenslet_column); read-only."""
        valid = np.asarray(self.outcome == LensletStatus.CONVERGED)
        valid.flags.writeable = False
        return valid

    def minus(self, bias: Floats) -> Self:
        """Subtract a known error, px, of the shape of `coefficients`; no covariance is computed for it."""
        return replace(self, coefficients=self.coefficients - bias)

    @property
    def mean_variance(self) -> Floats:
        """Mean variance of a lenslet's coefficients, px^2, (lenslet_row, lenslet_column); NaN where not converged."""
        source = vars(self).get("_covariance", self.covariance_source)  # the covariance if it has been computed
        if isinstance(source, Deferred):
            source = self.covariance
        trace = np.einsum("rcqdqd->rc", source) if isinstance(source, np.ndarray) else source.trace()
        return np.asarray(trace / (2 * self.modes.count))

    @property
    def variance(self) -> Floats:
        """Variance of each coefficient, px^2, (lenslet_row, lenslet_column, field_mode, xy)."""
        return np.asarray(np.einsum("rcqdqd->rcqd", self.covariance))

    @property
    def present(self) -> Booleans:
        """True for lenslets with an image in the reference, (lenslet_row, lenslet_column)."""
        return np.asarray(self.outcome != LensletStatus.ABSENT)

    @property
    def summary(self) -> list[str]:
        """Valid lenslets, lost and absent ones, and the used share of the dynamic range, in words."""
        valid = f"{np.count_nonzero(self.valid)} of {np.count_nonzero(self.present)} lenslets valid"
        counts = [(np.count_nonzero(self.outcome == each), each) for each in LensletStatus if each.reason]
        words = [
            f"{count} {'absent' if each is LensletStatus.ABSENT else 'lost'}: {each.reason}"
            for count, each in counts
            if count
        ]
        used = f"{100 * np.nanmax(self.range_used, initial=0.0):.0f} % of the dynamic range used"
        return [valid, *words, used]

    @property
    def mean(self) -> Floats:
        """Mean displacement over the field, px, (lenslet_row, lenslet_column, xy)."""
        return np.tensordot(field_means(self.modes), self.coefficients, axes=([0], [2]))


@lru_cache(maxsize=8)
def field_means(modes: FieldModes) -> Floats:
    """Mean of each field mode over the field, (field_mode,)."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    return np.asarray(np.einsum("qyx,y,x->q", modes.values(nodes, nodes[:, None]), weights, weights) / 4)


def diagonal_covariance(variance: Floats) -> Floats:
    """Covariance (..., field_mode, xy, field_mode, xy), px^2, from independent variances (..., field_mode, xy)."""
    modes, axes = variance.shape[-2:]
    return np.asarray(variance[..., None, None] * np.eye(modes * axes).reshape(modes, axes, modes, axes))


class RegistrationMethod(Protocol):
    """A registration method, prepared for one reference."""

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:
        """Register a frame, counts above the dark, (row, column), against the reference.

        `saturated` (row, column) marks pixels at full scale. `start`, from an earlier frame, may save time; it
        changes the result by far less than its error.
        """
        ...
