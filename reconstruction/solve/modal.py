"""Modal reconstruction: all coefficients e_pq of a wavefront in one solve, with error bars.

The parameters of all lenslets' warps (`sensitivity`) are linear in e_pq. One regularised least-squares problem joins
them with the full covariance of each lenslet. Wavefronts of layered samples span a subspace (`layered_modes`): of
119 x 10 coefficients 560 are free.

The smoothness prior: each coefficient is normally distributed about zero with standard deviation s (n + m)^-5 t^m, n
and m the degrees of R_p and T_q: a layer's polynomial has their sum. The strength s and the noise level maximise the
evidence of the data (MacKay, Neural Computation 4, 415, 1992); t is fixed, because results hardly depend on it. So
there may be as many modes as the lattice carries, lost lenslets are bridged by their neighbours, and what the source
does not show has the prior's variance.

Everything but two matrix-vector products is prepared with the reference. Lost and faint lenslets are taken out of the
prepared equations by down-dating.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.errors import TooManyModes
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.runtime.deferred import Deferred, Remembered
from reconstruction.runtime.threads import in_threads
from reconstruction.solve.evidence import Components, Estimate, FitQuality
from reconstruction.solve.expected_errors import ALIKE_IF_FREE, ExpectedErrors, Sensitivity, Whitened


@dataclass(frozen=True, slots=True, eq=False)
class KnownModes:
    """Pupil modes where the wavefront is known."""

    modes: PupilModes
    lenslets: Booleans  # (lenslet_row, lenslet_column)
    values: Floats  # of the modes there, minus their means, (pupil_mode - 1, known lenslet)


def known_modes(modes: PupilModes, used: Booleans, *, extrapolate: bool) -> KnownModes:
    """Modes at the lenslets used (row, column), and at neighbours if a prior bridges lost ones."""
    if extrapolate:
        used = modes.inside & ndimage.binary_dilation(used, structure=np.ones((3, 3), np.bool_))
    values = modes.values[1:, used]
    values -= values.mean(axis=1, keepdims=True) if used.any() else 0.0
    return KnownModes(modes, used, values)


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Independent components of a wavefront, each with a standard deviation that differs from frame to frame."""

    components: Image  # rad where each deviates by 1, in the first pupil modes, (pupil_mode - 1, field_mode, n)
    known: KnownModes

    def at(self, field_modes: Image) -> Image:
        """Wavefronts of the components at field positions (position, field_mode), (position, known lenslet, n)."""
        values = self.known.values[: len(self.components)].T.astype(np.float32)
        return np.stack([values @ (position @ self.components) for position in field_modes])


class Deviations(NamedTuple):
    """Standard deviations of one frame's components, and deviations beyond these."""

    spread: Spread
    of_components: Image  # (n,)
    others: Image  # rad, (pupil_mode - 1, field_mode, k)


_MOST_SQUARES = 3e7  # at a time; more take some hundred megabytes


@lru_cache(maxsize=1)  # live frames ask for the same positions, the views, again and again
def _squares(spread: Spread, field_modes: bytes) -> Image:
    """Squares of the wavefronts of the components, (position, known lenslet, n)."""
    return spread.at(np.frombuffer(field_modes, np.float32).reshape(-1, spread.components.shape[1])) ** 2


@dataclass(frozen=True, eq=False, kw_only=True)
class ModalSolution:
    """Dual-orthogonal coefficients of one wavefront; error bars are computed on request."""

    coefficients: Floats  # e_pq, rad, (pupil_mode, field_mode); zero for the piston
    _known: KnownModes
    _deviations: Deferred[Deviations]
    noise: float  # variance of the displacements' errors over that of the expected ones
    freedom: float  # number of data minus that of the components which they determine
    _displacement: Displacement
    parameters: Floats  # of the lenslets' warps, (K, 2Q)
    fitted: Deferred[Floats]  # parameters of the fit, px, (lenslet, K)
    energy: float = 0.0  # mean square of the displacements in expected errors
    shift_sigmas: Deferred[float] | None = None  # of assumed layers, see `LayeredWavefronts`

    def extended(self, known: KnownModes) -> Self:
        """The same wavefront in more pupil modes, whose coefficients are 0; known at the same lenslets."""
        coefficients = np.zeros((len(known.modes.degree), self.coefficients.shape[1]))
        coefficients[: len(self.coefficients)] = self.coefficients
        return replace(self, coefficients=coefficients, _known=known)

    @property
    def modes(self) -> PupilModes:
        """The pupil modes."""
        return self._known.modes

    @property
    def known(self) -> Booleans:
        """Lenslets at which the wavefront is known, (lenslet_row, lenslet_column)."""
        return self._known.lenslets

    def wavefront(self, field_modes: Floats) -> Floats:
        """Wavefront, rad, without piston, (..., lenslet_row, lenslet_column); NaN where unknown.

        `field_modes` (..., field_mode): values of the field modes T_q at the field positions.
        """
        phase = field_modes @ (self.coefficients[1:].T @ self._known.values)
        return self._on_lattice(np.asarray(phase))

    def sigma(self, field_modes: Floats) -> Floats:
        """Standard deviation of `wavefront`, rad, the same shape."""
        spread, deviation, others = self._deviations()
        flat = field_modes.reshape(-1, field_modes.shape[-1]).astype(np.float32)
        at_once = max(1, int(_MOST_SQUARES / max(spread.known.values.shape[1] * deviation.size, 1)))
        parts = [flat[first : first + at_once].tobytes() for first in range(0, len(flat), at_once)]
        variance = np.concatenate([_squares(spread, part) @ deviation**2 for part in parts])
        variance += np.sum(Spread(others, spread.known).at(flat) ** 2, axis=-1)
        return self._on_lattice(np.sqrt(variance, dtype=np.float64).reshape(*field_modes.shape[:-1], -1))

    def deviations(self, field_modes: Floats) -> Image:
        """Independent deviations of `wavefront`, each one standard deviation, for one field position.

        From field modes (field_mode,) to rad, (lenslet_row, lenslet_column, n); their squares add to the variance.
        """
        root = self.root_covariance
        deviations = np.full((*self.known.shape, root.shape[2]), np.nan, np.float32)
        deviations[self.known] = Spread(root, self._known).at(field_modes[None].astype(np.float32))[0]
        return deviations

    def _on_lattice(self, values: Floats) -> Floats:
        """Arrange values (..., known lenslet): (..., lenslet_row, lenslet_column), NaN where unknown."""
        if values.shape[-1] == self.known.size:
            return values.reshape(*values.shape[:-1], *self.known.shape)
        arranged = np.full((*values.shape[:-1], *self.known.shape), np.nan)
        arranged[..., self.known] = values
        return arranged

    @cached_property
    def coefficients_sigma(self) -> Floats:
        """Standard deviation of each coefficient, rad, (pupil_mode, field_mode); zero for the piston."""
        sigma = np.zeros_like(self.coefficients)
        sigma[1:] = np.linalg.norm(self.root_covariance, axis=-1)
        return sigma

    @property
    def displacement(self) -> Floats:
        """Displacements that the registration finds for this wavefront, px, (row, column, field_mode, xy)."""
        fitted = (self.fitted() @ self.parameters).reshape(*self.known.shape, 2, -1)
        return np.swapaxes(fitted, 2, 3)

    @cached_property
    def misfit(self) -> Floats:
        """Displacements minus the fit's, px, (lenslet_row, lenslet_column, field_mode, xy); NaN where lost."""
        return self._displacement.coefficients - self.displacement

    @cached_property
    def chi_square(self) -> float:
        """Reduced chi-square of the displacements about the fit: about 1 if the misfit is noise."""
        lenslets, valid = self._displacement.valid.size, self._displacement.valid.ravel() & self.known.ravel()
        misfit = np.swapaxes(self.misfit, 2, 3).reshape(lenslets, -1)[valid] @ self.parameters.T
        covariance = self._displacement.covariance.reshape(lenslets, *self.misfit.shape[2:], *self.misfit.shape[2:])
        covariance = covariance[valid].transpose(0, 2, 1, 4, 3).reshape(len(misfit), *2 * self.parameters.shape[1:])
        variance = np.einsum("ka,lab,kb->lk", self.parameters, covariance, self.parameters, optimize=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(np.sum(misfit**2 / variance) / self.freedom)

    @property
    def root_covariance(self) -> Image:
        """Square root of the coefficients' covariance, rad, (pupil_mode - 1, field_mode, n); without the piston.

        It includes the noise of the displacements and what the prior suppresses.
        """
        spread, deviation, others = self._deviations()
        root = np.concatenate([spread.components * deviation, others], axis=-1)
        return np.pad(root, ((0, len(self.coefficients) - 1 - len(root)), (0, 0), (0, 0)))


PRIOR_EXPONENT = 5.0  # of the degree; with 4 the residuals at 100,000 e- are a fifth larger
_PRIOR_PER_FIELD_DEGREE = 0.5  # t; with 0.25 or 1, residuals changed by 15 % at most, in most cases by 3 %
UNSEEN = 1e-14  # eigenvalue over the largest, below which it is rounding
_NOTHING = 1e-18  # eigenvalue over the largest, of what the displacements do not show
# Without a prior: largest variance of the wavefront in one component over the median component's. It is below 2000 for
# as many modes as the lattice carries, and above 20 000 for a tenth more.
_AMPLIFICATION = 1e4
_AT_ONCE = 64  # lenslets whose design matrix is in memory at a time
_TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """The problem of some lenslets in independent components: data = singular x + noise, e = scaled x."""

    singular: Floats  # (n,)
    vectors: Floats | None  # of the down-dated equations in the prepared components, (n, n); None if these are all
    spread: Spread  # whose components are `scaled`


def _blocks(basis: Floats) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Rows and columns of the blocks of a matrix outside which it is 0, as modes of different symmetry do not mix."""
    row, column = np.nonzero(basis)
    graph = sparse.coo_array((np.ones(len(row)), (row, len(basis) + column)), shape=(sum(basis.shape),) * 2)
    count, label = connected_components(graph, directed=False)
    of_row, of_column = label[: len(basis)], label[len(basis) :]
    return [(np.flatnonzero(of_row == block), np.flatnonzero(of_column == block)) for block in range(count)]


class ModalSolver:
    """Fits pupil modes, piston first, times field modes to displacements; prepared for one reference.

    Parameters
    ----------
    parameters : (K, 2Q)
        Displacement (x modes, y modes) of each parameter of the lenslets' warps, orthonormal rows.
    covariance : (lenslet_row, lenslet_column, field_mode, xy, field_mode, xy)
        Expected covariance of a frame's displacements, px^2; NaN where lost, 0 if unknown.
    layered : callable, optional
        Returns the basis of the wavefronts allowed, for coefficients in units (pupil_mode - 1, field_mode); see
        `layered_basis`.
    field_degree : (field_mode,), optional
        Degrees of the field modes; the prior is applied if they are given.
    """

    def __init__(
        self,
        modes: PupilModes,
        sensitivity: Sensitivity,
        parameters: Floats,
        covariance: Floats,
        *,
        layered: Callable[[Floats], Floats] | None = None,
        field_degree: Floats | None = None,
    ) -> None:
        self._modes, self._parameters = modes, parameters
        field_modes = parameters.shape[1] // 2
        self.errors = ExpectedErrors(sensitivity, parameters, covariance, modes.inside)
        self._is_smooth = field_degree is not None
        scale = np.ones((len(modes.degree) - 1, field_modes))
        if field_degree is not None:
            degree = modes.degree[1:, None] + field_degree
            scale = degree**-PRIOR_EXPONENT * _PRIOR_PER_FIELD_DEGREE**field_degree
        basis = np.diag(scale.ravel()) if layered is None else scale.reshape(-1, 1) * layered(scale)
        self._unknowns = basis.shape[1]
        chunks = [slice(first, first + _AT_ONCE) for first in range(0, modes.inside.size, _AT_ONCE)]
        blocks = _blocks(basis)

        def in_basis(some: slice) -> Floats:
            rows = self.errors.rows(modes, some)
            found = np.empty((len(rows), basis.shape[1]))
            for row, column in blocks:
                found[:, column] = rows[:, row] @ basis[np.ix_(row, column)]
            return found

        rows = in_threads(in_basis, chunks)
        self._singular, vectors = self._seen(*np.linalg.eigh(sum(in_threads(lambda some: some.T @ some, rows))))
        self._scaled = basis @ vectors
        to_left = vectors / self._singular
        across = np.concatenate(in_threads(lambda some: (some @ to_left).astype(np.float32), rows))
        self._across = across.T.copy()  # left singular vectors, (n, lenslet * K)
        self._equations = Remembered[_Equations](16)
        if not self._is_smooth:
            self._equations(self._down_dated, self.errors.is_usable.astype(np.float64).tobytes())  # fails early

    def __call__(self, displacement: Displacement, *, weights: Floats | None = None) -> ModalSolution:
        """Fit valid lenslets in the pupil; `weights` (lenslet_row, lenslet_column), default 1, scale those expected."""
        frame = self.errors.whitened(displacement, weights)
        equations, components = self._components(frame)
        estimate = components.estimate() if self._is_smooth else self._without_prior(components)
        found = estimate.values
        scaled = equations.spread.components
        coefficients = np.zeros((len(scaled) + 1, scaled.shape[1]))
        coefficients[1:] = (scaled.reshape(-1, found.size) @ found.astype(np.float32)).reshape(scaled.shape[:2])

        def fitted() -> Floats:
            prepared = found if equations.vectors is None else equations.vectors @ found
            whitened = (self._singular * prepared).astype(np.float32) @ self._across
            return np.asarray(np.matvec(self.errors.colour, whitened.reshape(frame.weighted.shape)))

        def deviations() -> Deviations:
            deviation = np.sqrt(self.errors.variance(estimate, components.singular, ALIKE_IF_FREE))
            return Deviations(equations.spread, deviation.astype(np.float32), scaled[..., :0])

        return ModalSolution(
            coefficients=coefficients,
            _known=equations.spread.known,
            _deviations=Deferred(deviations),
            noise=estimate.noise,
            freedom=estimate.freedom,
            _displacement=displacement,
            parameters=self._parameters,
            fitted=Deferred(fitted),
        )

    def quality(self, displacement: Displacement, *, weights: Floats | None = None) -> FitQuality:
        """Fit quality of wavefronts with the smoothness prior; `weights` as for the fit."""
        return self._components(self.errors.whitened(displacement, weights))[1].quality()

    def _components(self, frame: Whitened) -> tuple[_Equations, Components]:
        """Equations of the lenslets used, and the data along their components."""
        equations = self._equations(self._down_dated, frame.share.tobytes())
        along = (self._across @ frame.weighted.ravel().astype(np.float32)).astype(np.float64)
        if equations.vectors is not None:
            along = np.vecmat(self._singular * along, equations.vectors) / equations.singular
        return equations, Components(equations.singular, along, frame.total, frame.number)

    def _without_prior(self, components: Components) -> Estimate:
        singular, along, total, count = components
        noise = 1.0 if self.errors.share_of_noise else _TINY
        if count > len(singular):  # what the modes leave shows errors that the noise does not explain
            noise = max((total - float(along @ along)) / (count - len(singular)), noise)
        return Estimate(along / singular, math.inf, noise, count - len(singular))

    def _down_dated(self, share_bytes: bytes) -> _Equations:
        """The equations of lenslets with that share of their certainty, (lenslet,)."""
        share = np.frombuffer(share_bytes)
        lost = np.flatnonzero(self.errors.is_usable & (share < 1))
        singular, vectors, scaled = self._singular, None, self._scaled
        if lost.size:
            # In double precision: what only these lenslets show must vanish.
            missing = self.errors.rows(self._modes, lost) @ self._scaled / self._singular  # left singular vectors
            missing = missing.reshape(lost.size, -1, len(singular))
            weighted = (1 - share[lost, None, None]) * missing
            left = np.eye(len(singular)) - np.tensordot(missing, weighted, axes=([0, 1], [0, 1]))
            singular, vectors = self._seen(*np.linalg.eigh(singular[:, None] * left * singular))
            scaled = scaled @ vectors
        used = (share > 0).reshape(self._modes.inside.shape)
        known = known_modes(self._modes, used, extrapolate=self._is_smooth)
        if not self._is_smooth:
            self._require_distinct(known.values, scaled / singular)
        components = scaled.astype(np.float32).reshape(len(self._modes.degree) - 1, -1, len(singular))
        return _Equations(singular, vectors, Spread(components, known))

    def _seen(self, square: Floats, vectors: Floats) -> tuple[Floats, Floats]:
        """Singular values (n,) and vectors of the components shown; a prior adds the others, with its variance."""
        least = max(square[-1], _TINY)
        if self._is_smooth:
            return np.sqrt(np.maximum(square, _NOTHING * least)), vectors
        seen = square > UNSEEN * least
        return np.sqrt(square[seen]), vectors[:, seen]

    def _require_distinct(self, values: Floats, scaled: Floats) -> None:
        """Raise if a component without a prior is unseen, or its noise dominates the wavefront.

        `values` (pupil_mode - 1, lenslet); `scaled` (coefficient, n), coefficients per unit of noise.
        """
        if values.shape[1] and scaled.shape[1] == self._unknowns:
            wavefronts = np.tensordot(values, scaled.reshape(len(values), -1, scaled.shape[1]), axes=(0, 0))
            flat = wavefronts.reshape(-1, scaled.shape[1])
            variance = np.linalg.eigvalsh(flat.T @ flat)
            if variance[-1] <= _AMPLIFICATION * np.median(variance):
                return
        raise TooManyModes(values.shape[1], len(self._modes.degree))
