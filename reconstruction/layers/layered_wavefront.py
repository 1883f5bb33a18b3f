"""Wavefront of a sample that is known to be one or two thin layers.

What one lenslet sees inside its field, its neighbours see at their edges, shifted by ratio x: layers determine the
wavefront even where the source is blind (docs/layers.md).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from reconstruction.arrays import Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.layers.layer_fit import LayerFit
from reconstruction.layers.layer_modes import LayerModes
from reconstruction.layers.layer_search import LayerSearch
from reconstruction.layers.layer_solver import FrameEquations, LayerSolver
from reconstruction.solve.modal_solution import ModalSolution, known_modes

_STEP = 5e-3  # of a ratio r, times 1 + |r|, for the wavefront's derivative


@dataclass(frozen=True, slots=True, eq=False)
class AssumedSample:
    """Assumption about the sample: layers at some ratios of field to pupil position, or none: any wavefront."""

    ratios: tuple[float, ...] = ()
    covariance: Floats | None = None  # of the ratios, (layer, layer); None if they are known

    @property
    def sigma(self) -> Floats:
        """Standard deviation of the ratios, (layer,); 0 if they are known."""
        return np.zeros(len(self.ratios)) if self.covariance is None else np.sqrt(np.diag(self.covariance))


FREE = AssumedSample()


def most_probable(search: LayerSearch, *, free: bool = True) -> AssumedSample:
    """Assumption with the highest evidence: one layer, two, or with `free` any wavefront."""
    fits = [fit for fit in (search.one, search.two) if fit is not None]
    best = max(fits, key=lambda fit: fit.quality.log_evidence)
    if free and best.quality.log_evidence < search.any_wavefront.log_evidence:
        return FREE
    return AssumedSample(tuple(layer.ratio for layer in best.layers), best.ratio_covariance)


class LayeredWavefronts:
    """Wavefronts of layers fitted to the displacements measured against one reference."""

    def __init__(self, solver: LayerSolver, modes: LayerModes, parameters: Floats) -> None:
        """`parameters` (K, 2Q): displacement (x modes, y modes) of each parameter of the warp."""
        self.solver, self._modes, self._parameters = solver, modes, parameters
        self._basis = lru_cache(maxsize=12)(modes)

    def __call__(self, displacement: Displacement, weights: Floats | None, sample: AssumedSample) -> ModalSolution:
        """Fit layers at the ratios of the sample.

        Raises `ReconstructionError` if too few lenslets are valid.
        """
        equations = self.solver(displacement, weights)
        fit = equations.fit(*sample.ratios)
        shape = len(self._modes.pupil_modes.degree), displacement.modes.count
        coefficients = np.zeros(shape)
        coefficients[1:][self._modes.columns] = self._wavefront(fit)

        def root_covariance() -> Image:
            parts = [self._basis(layer.ratio) @ layer.root_covariance for layer in fit.layers]
            columns = np.concatenate([np.sum(parts, axis=0), self._of_distances(equations, sample)], axis=1)
            root = np.zeros((shape[0] - 1, shape[1], columns.shape[1]), np.float32)
            root[self._modes.columns] = columns
            return root

        def fitted() -> Floats:
            return np.asarray(np.matvec(self.solver.errors.colour, equations.explained(fit)))

        return ModalSolution(
            coefficients,
            known_modes(self._modes.pupil_modes, displacement.valid, extrapolate=True),
            root_covariance,
            equations.freedom(fit),
            displacement,
            self._parameters,
            fitted,
        )

    def _wavefront(self, fit: LayerFit) -> Floats:
        """Coefficients of the wavefront of layers, rad, (column,)."""
        return np.asarray(np.sum([self._basis(layer.ratio) @ layer.coefficients for layer in fit.layers], axis=0))

    def _of_distances(self, equations: FrameEquations, sample: AssumedSample) -> Floats:
        """Deviations of the coefficients that the uncertain distances cause, (column, layer)."""
        slopes = []
        if sample.covariance is None:
            return np.zeros((np.count_nonzero(self._modes.columns), 0))
        for place, ratio in enumerate(sample.ratios):
            step = _STEP * (1 + abs(ratio))
            near, far = (
                self._wavefront(equations.fit(*(r + side * step * (i == place) for i, r in enumerate(sample.ratios))))
                for side in (-1, 1)
            )
            slopes.append((far - near) / (2 * step))
        values, vectors = np.linalg.eigh(sample.covariance)
        return np.asarray(np.transpose(slopes) @ (vectors * np.sqrt(np.maximum(values, 0.0))))
