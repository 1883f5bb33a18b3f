"""Wavefront of a sample that is known to be one thin layer, two, or a slab of three.

What one lenslet sees inside its field, its neighbours see at their edges, shifted by ratio x: layers determine the
wavefront even where the source is blind (docs/layers.md).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.layers.layer_search import LayerSearch, explains, is_within
from reconstruction.layers.layer_solver import (
    SKETCH_DEGREE,
    LayerFit,
    LayerModes,
    LayerSolver,
    divided,
    principal,
    prior_scale,
    require_lenslets,
)
from reconstruction.runtime.deferred import Deferred, Remembered
from reconstruction.solve.evidence import Components, Estimate
from reconstruction.solve.expected_errors import ALIKE_IN_LAYERS, Whitened
from reconstruction.solve.modal import Deviations, KnownModes, ModalSolution, Spread, known_modes

_STEP = 5e-3  # of a ratio r, times 1 + |r|, for the wavefront's derivative
_DECISIVE = 5.0  # by which the log evidence must favour layers, at distances found among many
_ALONE = 1e-9  # variance of distances over the largest, below which they follow from others
_TINY = np.finfo(np.float64).tiny
_NEGLIGIBLE_RAD = 1e-20  # denormal numbers take fifty times as long as others or 0


@dataclass(frozen=True, slots=True, eq=False)
class AssumedSample:
    """Assumed sample: layers at some ratios of field to pupil position, three for a slab, none for any wavefront."""

    ratios: tuple[float, ...] = ()
    covariance: Floats | None = None  # of the ratios, (layer, layer); None if they are known
    rivals: tuple[float, ...] = ()  # ratios of other layers that explain the frame as well; empty if there are none
    allowed: float = 1.0  # `Reconstructor.contradiction` by a frame of this sample, at most

    @property
    def sigma(self) -> Floats:
        """Standard deviation of the ratios, (layer,); 0 if they are known."""
        return np.zeros(len(self.ratios)) if self.covariance is None else np.sqrt(np.diag(self.covariance))


FREE = AssumedSample()


def most_probable(search: LayerSearch, *, may_be_free: bool = True, is_blind: bool = False) -> AssumedSample:
    """One layer where it explains the displacements; else what has the highest evidence.

    That is any wavefront, too, if the sample `may_be_free`. A slab represents two layers, unless the source hides
    displacements (`is_blind`): there its wavefronts are too free, and it is the two layers' rival if their evidence is
    not decisive, where systematic errors that are alike in some lenslets count as one.

    Evidence takes all errors for independent. So systematic ones, far below 1 % of the displacements, make it prefer a
    second layer at the end of the search, or a free wavefront, which is far off if the source hides displacements
    (`is_blind`). Layers at the end of the search are not found: their true place is beyond it.
    """
    one, any_wavefront = search.one, search.any_wavefront
    if is_within(one) and explains(one.quality, any_wavefront, is_blind=is_blind):
        return _assumed(one)
    slab = search.slab if search.slab is not None and is_within(search.slab) else None
    deep = search.two if is_blind or slab is None else slab
    found = [fit for fit in (one, deep) if fit is not None and is_within(fit)]
    if may_be_free and not found:
        return FREE
    best = max(found or [one], key=lambda fit: fit.quality.log_evidence)
    is_less_probable = best.quality.log_evidence < any_wavefront.log_evidence + _DECISIVE
    if may_be_free and is_less_probable:
        return FREE
    least = best.quality.log_evidence - _DECISIVE * ALIKE_IN_LAYERS
    is_open = best is search.two and slab is not None and slab.quality.log_evidence > least
    return _assumed(best, slab if is_open else None)


def _assumed(fit: LayerFit, rival: LayerFit | None = None) -> AssumedSample:
    rivals = () if rival is None else tuple(layer.ratio for layer in rival.layers)
    return AssumedSample(tuple(layer.ratio for layer in fit.layers), fit.ratio_covariance, rivals)


class _Design(NamedTuple):
    """Layers at some ratios for all lenslets, in independent components: data = singular x + noise."""

    singular: Floats  # (n,); 0 where the displacements show nothing
    vectors: Floats  # polynomials of the layers in units of the prior, (k, n)
    across: Image  # left singular vectors, (n, L * K)
    wavefronts: Image  # rad, (column, n)


class _Equations(NamedTuple):
    """The same for lenslets with some shares, in components of their own."""

    singular: Floats  # (n,)
    vectors: Floats | None  # in those for all lenslets, (n, n); None if these are all
    spread: Spread  # of the wavefronts of the components


class _Slopes(NamedTuple):
    """Change of the displacements with the ratio of each layer, for lenslets with some shares."""

    columns: NDArray[np.float32]  # of the polynomials of low degree of all layers, (m, L * K)
    polynomials: Floats  # these polynomials of the components for all lenslets, (m, n)
    along: Floats  # products of the columns with the displacements of these components, (m, n)
    own: Floats  # and with each other, (m, m)


class _Fit(NamedTuple):
    """Layers fitted to one frame."""

    design: _Design
    equations: _Equations
    estimate: Estimate
    values: Floats  # of the components for all lenslets, (n,)
    wavefront: Image  # coefficients, rad, (column,)


class LayeredWavefronts:
    """Wavefronts of layers fitted to displacements of a reference, by two matrices that are prepared once."""

    def __init__(self, solver: LayerSolver, modes: LayerModes, parameters: Floats) -> None:
        """`parameters` (K, 2Q): displacement (x modes, y modes) of each parameter of the warp."""
        self.solver, self._modes, self._parameters = solver, modes, parameters
        self._design = Remembered[_Design](6)  # of 7 MB; two layers need five for their error bars, and one for a rival
        self._equations = Remembered[_Equations](12)
        self._slopes = Remembered[_Slopes](12)  # of 1 MB
        self._known = Remembered[KnownModes](4)

    def __call__(
        self, displacement: Displacement, weights: Floats | None, sample: AssumedSample, *, is_corrected: bool = False
    ) -> ModalSolution:
        """Fit layers at the sample's ratios to displacements; `ReconstructionError` if too few lenslets are valid."""
        errors, columns = self.solver.errors, self._modes.columns
        frame = errors.whitened(displacement, weights)
        require_lenslets(frame)
        fit = self._fit(sample.ratios, frame)
        shape = len(self._modes.pupil_modes.degree), displacement.modes.count
        coefficients = np.zeros(shape)
        coefficients[1:][columns] = fit.wavefront
        design, (singular, _, spread), estimate, values, _ = fit

        def deviations() -> Deviations:
            has_depth = len(sample.ratios) > 1 and not is_corrected
            deviation = np.sqrt(errors.variance(estimate, singular, ALIKE_IN_LAYERS, has_depth=has_depth))
            of_sample = self._of_sample(sample, frame, fit)
            others = np.zeros((shape[0] - 1, shape[1], of_sample.shape[1]), np.float32)
            others[columns] = of_sample
            return Deviations(spread, deviation.astype(np.float32), others)

        def fitted() -> Floats:
            whitened = (design.singular * values).astype(np.float32) @ design.across
            return np.asarray(np.matvec(errors.colour, whitened.reshape(frame.weighted.shape)))

        return ModalSolution(
            coefficients=coefficients,
            _known=spread.known,
            _deviations=Deferred(deviations),
            noise=estimate.noise,
            freedom=estimate.freedom,
            _displacement=displacement,
            parameters=self._parameters,
            fitted=Deferred(fitted),
            energy=frame.total / frame.number,
            shift_sigmas=Deferred(lambda: self._shift_sigmas(sample, frame, fit)),
        )

    def in_these_modes(self, free: ModalSolution) -> ModalSolution:
        """A wavefront that was found without layers, in as many pupil modes as with them."""
        return free.extended(self._known(self._known_at, free.known.tobytes()))

    def _known_at(self, lenslets: bytes) -> KnownModes:
        modes = self._modes.pupil_modes
        return known_modes(modes, np.frombuffer(lenslets, np.bool_).reshape(modes.inside.shape), extrapolate=False)

    def _fit(self, ratios: tuple[float, ...], frame: Whitened) -> _Fit:
        """Fit layers to the displacements of a frame."""
        design = self._design(self._prepared, ratios)
        equations = self._equations(self._down_dated, ratios, frame.share.tobytes())
        along = (design.across @ frame.weighted.ravel().astype(np.float32)).astype(np.float64)
        if equations.vectors is not None:
            along = divided(np.vecmat(design.singular * along, equations.vectors), equations.singular)
        estimate = Components(equations.singular, along, frame.total, frame.number).estimate()
        values = estimate.values if equations.vectors is None else equations.vectors @ estimate.values
        return _Fit(design, equations, estimate, values, design.wavefronts @ values.astype(np.float32))

    def _rows(self, ratios: tuple[float, ...]) -> Floats:
        """Whitened displacements of each polynomial in units of the prior, (L * K, k).

        In double precision: the prior makes small eigenvalues count, and layers close to each other differ little.
        """
        degree = self.solver.degree
        rows = np.concatenate([self.solver.rows(ratio, degree) * prior_scale(degree) for ratio in ratios], axis=2)
        return rows.reshape(-1, rows.shape[2])

    def _prepared(self, ratios: tuple[float, ...]) -> _Design:
        """Design of layers at some ratios, for all lenslets."""
        rows, scale = self._rows(ratios), prior_scale(self.solver.degree)
        singular, vectors = principal(rows.T @ rows)
        across = divided(rows @ vectors, singular).astype(np.float32).T.copy()
        wavefronts = np.concatenate([self._modes(ratio) * scale for ratio in ratios], axis=1) @ vectors
        wavefronts[np.abs(wavefronts) < _NEGLIGIBLE_RAD] = 0
        return _Design(singular, vectors, across, wavefronts.astype(np.float32))

    def _down_dated(self, ratios: tuple[float, ...], share_bytes: bytes) -> _Equations:
        """Equations of lenslets with some shares (L,) of their certainty."""
        design, share = self._design(self._prepared, ratios), np.frombuffer(share_bytes)
        lost = np.flatnonzero(self.solver.errors.is_usable & (share < 1))
        singular, vectors, wavefronts = design.singular, None, design.wavefronts
        if lost.size:
            rows = self._rows(ratios)
            missing = rows.reshape(len(share), -1, rows.shape[1])[lost] @ design.vectors
            weighted = (1 - share[lost, None, None]) * missing
            gram = np.diag(singular**2) - np.tensordot(missing, weighted, axes=([0, 1], [0, 1]))
            singular, vectors = principal(gram)
            wavefronts = wavefronts @ vectors.astype(np.float32)
        modes = self._modes.pupil_modes
        known = known_modes(modes, (share > 0).reshape(modes.inside.shape), extrapolate=True)
        components = np.zeros((*self._modes.columns.shape, len(singular)), np.float32)
        components[self._modes.columns] = wavefronts
        return _Equations(singular, vectors, Spread(components, known))

    def _shift_sigmas(self, sample: AssumedSample, frame: Whitened, fit: _Fit) -> float:
        """Shift of the layers that would explain the rest of the displacements best, in standard errors.

        The errors are those of the assumed ratios and of this frame, see `ExpectedErrors.variance`.
        """
        columns, polynomials, along, own = self._slopes(self._per_ratio, sample.ratios, frame.share.tobytes())
        (singular, vectors, _), estimate, alone = fit.equations, fit.estimate, np.eye(len(sample.ratios))
        low = len(own) // len(alone)  # of each layer
        phase = np.repeat(alone, low, axis=1) * (polynomials @ fit.values)  # (layer, m)
        score = phase @ (columns @ frame.weighted.ravel().astype(np.float32) - along @ fit.values)
        explained = phase @ along if vectors is None else phase @ along @ vectors
        explained /= np.sqrt(singular**2 + 1 / estimate.ratio)  # by the phase itself
        normal = phase @ own @ phase.T - explained @ explained.T
        variance = self.solver.errors.larger(estimate.noise, ALIKE_IN_LAYERS) * normal + _TINY * alone
        if sample.covariance is not None:
            variance += normal @ sample.covariance @ normal
        return math.sqrt(max(float(score @ np.linalg.solve(variance, score)), 0.0))

    def _per_ratio(self, ratios: tuple[float, ...], share_bytes: bytes) -> _Slopes:
        """Slopes for lenslets with some shares (L,) of their certainty."""
        rows, share = self._rows(ratios), np.frombuffer(share_bytes)
        vectors = self._design(self._prepared, ratios).vectors
        degree, change = min(SKETCH_DEGREE, self.solver.degree), []
        for ratio in ratios:
            step = _STEP * (1 + abs(ratio))
            before, after = (self.solver.rows(ratio + side * step, degree) for side in (-1, 1))
            change.append((after - before).reshape(len(rows), -1) * prior_scale(degree) / (2 * step))
        columns = np.concatenate(change, axis=1).T
        low = vectors.reshape(len(ratios), -1, len(vectors))[:, : len(columns) // len(ratios)]
        along = np.repeat(share, len(rows) // len(share)) * columns
        polynomials = low.reshape(len(columns), -1)
        return _Slopes(columns.astype(np.float32, order="C"), polynomials, along @ rows @ vectors, along @ columns.T)

    def _of_sample(self, sample: AssumedSample, frame: Whitened, fit: _Fit) -> Floats:
        """Independent deviations of the coefficients of a fit by uncertain distances and by rivals, (column, n)."""
        deviations = [self._fit(sample.rivals, frame).wavefront - fit.wavefront] if sample.rivals else []
        if sample.covariance is not None:
            values, vectors = np.linalg.eigh(sample.covariance)
            ratios, step = np.array(sample.ratios), _STEP * (1 + np.abs(sample.ratios).max())
            for value, vector in zip(values, vectors.T, strict=True):
                if value > _ALONE * values[-1]:  # a slab's ends determine its middle
                    near, far = (self._fit(tuple((ratios + side * step * vector).tolist()), frame) for side in (-1, 1))
                    deviations.append((far.wavefront - near.wavefront) * (math.sqrt(value) / (2 * step)))
        return np.reshape(deviations, (len(deviations), fit.wavefront.size)).T
