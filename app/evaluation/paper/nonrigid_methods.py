"""Non-rigid registration methods that the paper names, next to svwfs's own in `svwfs paper`.

They find a displacement for every pixel of a subimage, a flow, of which the values at the views are used.

*Block flow* (Wu et al. 2021, Cell 184, 3318): 7 x 7 blocks of the field are searched for in the frame's subimage by
correlation; cubic interpolation yields a shift for every pixel. Choices where the paper leaves them open, for sources
without structure:

* Blocks overlap and are wider than a seventh of the field, 2.5 px, which is less than the diffraction blur.
* The peak is that of the normalised correlation, refined by one parabola along x and another along y.
* The structure tensor of a block, sum of grad I0 grad I0^T, says which shifts it can see. Directions with less than a
  fraction of the best block's structure have no weight; a thin plate through the other shifts fills them in.

*Diffeomorphic demons* (Vercauteren et al. 2009, NeuroImage 45, S61) push every pixel along the gradient and smooth the
result; *free-form deformation* (Rueckert et al. 1999, IEEE Trans. Med. Imaging 18, 712) moves the control points of a
cubic B-spline. Both are SimpleITK's and start from the affine map, because nothing shows motion inside a uniform
square: from zero they leave 2 rad of residual, where the affine map leaves 0.4. None of the methods conserves flux.
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage
from scipy.interpolate import make_interp_spline

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement, LensletStatus, diagonal_covariance
from reconstruction.geometry import Field, centered_steps
from reconstruction.modes.field_modes import SampledModes
from reconstruction.registration.itk_affine import align_affine, load_simple_itk, map_lenslets, mean_squares, misfit
from reconstruction.registration.subimages import ReferenceSubimages, classify_lenslets

_BLOCKS = 7  # along x and along y
_BLOCK_PX = 9  # odd width of a block; 7 see too little of a square's blurred edge
_FAINT = 0.1  # of the best block's structure; weaker directions have no weight
_STIFFNESS = 1e-2  # of the plate, in units of the best block's structure
_REST = 1e-9  # pull towards no shift, which keeps the system regular in the dark
_FLAT = 1e-3  # of the subimage's contrast; flatter parts of the frame do not correlate

_CONTRAST = 64.0  # standard deviation of the grey values for SimpleITK
_DEMONS_SMOOTHING_PX = 2.0  # of the displacement, after each iteration
_DEMONS_ITERATIONS = 20
_DEMONS_SAME = 0.3 * _CONTRAST  # smaller differences of grey values exert no force: they are flux, not motion
_MESH = 2  # elements of the B-spline along x and y; with 4 the inside of a square bends arbitrarily
_FREE_FORM_ITERATIONS = 20
_FREE_FORM_TOLERANCE = 1e-5  # of the gradient's convergence, as SimpleITK defines it


class _NonRigid(ABC):
    """Registration by a flow d(x): displacements at every pixel x of the reference's windows."""

    def __init__(self, reference: ReferenceSubimages, field: Field) -> None:
        """Prepare for one reference and the views of the field."""
        self._reference = reference
        self._modes = SampledModes(field.view_x_m / field.half_width_m, field.view_y_m / field.half_width_m)
        self._at_views = _bilinear(self._modes, reference.half_width_px, reference.width)
        # The variance of a translation, sigma^2 / sum |dI0/dx|^2, is that of a mean of N independent pixels.
        strength = np.sum(reference.gradient**2, axis=1)  # (L, xy)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = np.where(reference.lit[:, None], len(reference.offset_px) / strength, 0.0)
        self._variance = pixel[:, None] * np.sum(self._at_views**2, axis=1)[:, None]  # (L, view, xy)

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        reference = self._reference
        subimages = reference.cut(light)
        flow = self._flow(subimages)
        residual_rms, found = misfit(reference, subimages, flow)
        return classify_lenslets(
            reference,
            self._modes,
            np.swapaxes(self._at_views @ flow, 1, 2),
            covariance=diagonal_covariance(self._variance * residual_rms[:, None, None] ** 2),
            residual_rms=residual_rms / reference.contrast.max(),
            contrast=subimages.std(axis=(1, 2)),
            faults={LensletStatus.DIVERGED: ~found, LensletStatus.SATURATED: reference.touched(saturated)},
        )

    @abstractmethod
    def _flow(self, subimages: Floats) -> Floats:
        """Flow (L, N, xy), px, NaN where lost, to the subimages (L, width, width) of a frame."""


def _bilinear(modes: SampledModes, half_width_px: float, width: int) -> Floats:
    """Weights of the window's pixels for the value at each node: (node, N)."""
    along = [np.array(nodes) * half_width_px + (width - 1) / 2 for nodes in modes.nodes]
    x, y = (np.maximum(1 - np.abs(position[:, None] - np.arange(width)), 0) for position in along)
    return np.asarray((y[:, :, None] * x[:, None, :]).reshape(modes.count, -1))


class BlockFlow(_NonRigid):
    """Registration by the correlation of blocks."""

    def __init__(self, reference: ReferenceSubimages, field: Field) -> None:
        super().__init__(reference, field)
        self._reach = max(1, int(np.ceil(reference.reach_px - reference.half_width_px)))  # of the shifts, px
        # Blocks lie on whole pixels.
        self._center_px = np.rint(centered_steps(_BLOCKS) * (2 * reference.half_width_px / _BLOCKS))
        pixels_px = np.clip(centered_steps(reference.width), -reference.half_width_px, reference.half_width_px)
        self._interpolation = make_interp_spline(self._center_px, np.eye(_BLOCKS), k=3)(pixels_px)  # (width, block)

        windows = reference.light.reshape(-1, reference.width, reference.width)
        blocks = self._blocks(windows)
        blocks = blocks - blocks.mean(axis=(-2, -1), keepdims=True)
        norm = np.sqrt(np.sum(blocks**2, axis=(-2, -1), keepdims=True))
        self._templates = blocks / np.where(norm > 0, norm, 1.0)  # (L, block_row, block_column, row, column)
        self._structure, self._plate = self._prepare_plate()

    def _flow(self, subimages: Floats) -> Floats:
        seen = self._structure @ self._search(subimages)[..., None]
        shift = self._plate @ seen.reshape(len(seen), -1, 1)
        shift = shift.reshape(-1, _BLOCKS, _BLOCKS, 2)
        flow = np.einsum("yi,xj,lijd->lyxd", self._interpolation, self._interpolation, shift, optimize=True)
        return np.asarray(flow.reshape(len(flow), -1, 2))

    def _padded(self, windows: Floats, reach: int) -> tuple[Floats, NDArray[np.intp]]:
        """Windows (L, width, width) padded for blocks moved by up to `reach`, and the first pixels of blocks."""
        margin = reach + _BLOCK_PX
        padded = np.pad(windows, ((0, 0), (margin, margin), (margin, margin)), mode="edge")
        middle = self._reference.width // 2 + margin
        return padded, (self._center_px + middle).astype(np.intp) - _BLOCK_PX // 2 - reach

    def _blocks(self, windows: Floats) -> Floats:
        """Blocks of the windows (L, width, width): (L, block_row, block_column, row, column)."""
        padded, first = self._padded(windows, 0)
        return sliding_window_view(padded, (_BLOCK_PX, _BLOCK_PX), axis=(1, 2))[:, first[:, None], first]

    def _search(self, subimages: Floats) -> Floats:
        """Shift with the best normalised correlation, px, (L, block_row, block_column, xy)."""
        correlation = self._correlation(subimages)
        # Only inner shifts have the neighbours that locate a peak.
        inner = correlation[..., 1:-1, 1:-1]
        best = np.argmax(inner.reshape(*inner.shape[:3], -1), axis=-1)
        row, column = np.unravel_index(best, inner.shape[3:])
        lenslet, i, j = np.ogrid[: len(subimages), :_BLOCKS, :_BLOCKS]
        peak = sliding_window_view(correlation, (3, 3), axis=(3, 4))[lenslet, i, j, row, column]
        across = np.stack([peak[..., 1, :], peak[..., :, 1]], axis=-2)  # through the peak along x, along y
        return np.stack([column, row], axis=-1) - self._reach + _vertex(across)

    def _correlation(self, subimages: Floats) -> Floats:
        """Correlation (L, block_row, block_column, shift_row, shift_column), with a margin of one shift."""
        reach = self._reach + 1
        shifts = 2 * reach + 1
        padded, first = self._padded(subimages, reach)
        mean, mean_square = (
            ndimage.uniform_filter(image, (0, _BLOCK_PX, _BLOCK_PX), mode="nearest") for image in (padded, padded**2)
        )
        spread = np.sqrt(np.maximum(mean_square - mean**2, 0))  # of the block about each pixel
        flat = np.maximum(_FLAT * subimages.std(axis=(1, 2)), np.finfo(np.float32).tiny)
        norm = _BLOCK_PX * np.maximum(spread, flat[:, None, None])
        half = _BLOCK_PX // 2
        correlation = np.empty((len(subimages), _BLOCKS, _BLOCKS, shifts, shifts))
        for i, row in enumerate(first):
            for j, column in enumerate(first):
                around = padded[:, row : row + shifts + 2 * half, column : column + shifts + 2 * half]
                moved = sliding_window_view(around, (_BLOCK_PX, _BLOCK_PX), axis=(1, 2))
                middle = norm[:, row + half : row + half + shifts, column + half : column + half + shifts]
                correlation[:, i, j] = np.einsum("lstyx,lyx->lst", moved, self._templates[:, i, j]) / middle
        return correlation

    def _prepare_plate(self) -> tuple[Floats, Floats]:
        """Tensors (L, block_row, block_column, xy, xy), and the plate that fills in shifts, (L, shifts, shifts)."""
        gradient = self._reference.gradient.reshape(-1, self._reference.width, self._reference.width, 2)
        along_x, along_y = (self._blocks(gradient[..., axis]) for axis in (0, 1))
        tensor = np.empty((*along_x.shape[:3], 2, 2))
        tensor[..., 0, 0], tensor[..., 1, 1] = np.sum(along_x**2, axis=(-2, -1)), np.sum(along_y**2, axis=(-2, -1))
        tensor[..., 0, 1] = tensor[..., 1, 0] = np.sum(along_x * along_y, axis=(-2, -1))
        strength, direction = np.linalg.eigh(tensor)
        best = strength.max(axis=(1, 2, 3), keepdims=True)
        strength = strength / np.where(best > 0, best, 1.0)
        strength = np.where(strength > _FAINT, strength, 0.0)
        structure = (direction * strength[..., None, :]) @ np.swapaxes(direction, -1, -2)

        bend = np.diff(np.eye(_BLOCKS), 2, axis=0)
        slope = np.diff(np.eye(_BLOCKS), axis=0)
        plain = np.eye(_BLOCKS)
        bends = [np.kron(bend, plain), np.sqrt(2) * np.kron(slope, slope), np.kron(plain, bend)]
        energy = sum(matrix.T @ matrix for matrix in bends)
        blocks = _BLOCKS**2
        system = np.zeros((len(structure), blocks, 2, blocks, 2))
        diagonal = np.arange(blocks)
        system[:] = np.kron(_STIFFNESS * energy + _REST * np.eye(blocks), np.eye(2)).reshape(system.shape[1:])
        system[:, diagonal, :, diagonal] += np.swapaxes(structure.reshape(-1, blocks, 2, 2), 0, 1)
        plate = np.linalg.inv(system.reshape(-1, 2 * blocks, 2 * blocks))
        return np.asarray(structure, np.float64), np.asarray(plate, np.float64)


def _vertex(values: Floats) -> Floats:
    """Peak of the parabola through three neighbours (..., 3), px from the middle one, at most half."""
    before, middle, after = np.moveaxis(values, -1, 0)
    curvature = before - 2 * middle + after
    peaked = curvature < 0
    return np.where(peaked, np.clip((before - after) / (2 * np.where(peaked, curvature, 1.0)), -0.5, 0.5), 0.0)


class _Deformable(_NonRigid):
    """A non-rigid registration of every lenslet's pair of images, scaled to equal brightness."""

    _threads = 2

    def __init__(self, reference: ReferenceSubimages, field: Field) -> None:
        super().__init__(reference, field)
        self._itk = load_simple_itk()
        self._windows = _equally_bright(reference.light.reshape(-1, reference.width, reference.width))

    def _flow(self, subimages: Floats) -> Floats:
        shape = (len(self._reference.offset_px), 2)
        return map_lenslets(self._align, self._windows, _equally_bright(subimages), shape, threads=self._threads)

    def _align(self, reference: Image, subimage: Image) -> Floats | None:
        """Flow of one lenslet, (N, xy), px; None if ITK fails."""
        itk = self._itk
        still, moved = itk.GetImageFromArray(reference), itk.GetImageFromArray(subimage)
        try:
            flow = self._field(still, moved, align_affine(itk, still, moved))
        except RuntimeError:  # SimpleITK's only exception: the images do not overlap
            return None
        return np.asarray(itk.GetArrayFromImage(flow), np.float64).reshape(-1, 2)

    @abstractmethod
    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        """Field d of two ITK images from the affine map `start`, reference(x) ~ subimage(x + d(x))."""


class Demons(_Deformable):
    """Registration by diffeomorphic demons."""

    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        itk = self._itk
        field = itk.TransformToDisplacementField(start, itk.sitkVectorFloat64, reference.GetSize())
        demons = itk.DiffeomorphicDemonsRegistrationFilter()
        demons.SetNumberOfThreads(1)
        demons.SetStandardDeviations(_DEMONS_SMOOTHING_PX)
        demons.SetNumberOfIterations(_DEMONS_ITERATIONS)
        demons.SetIntensityDifferenceThreshold(_DEMONS_SAME)
        return demons.Execute(reference, subimage, field)


class FreeForm(_Deformable):
    """Registration by free-form deformation."""

    _threads = 1  # two L-BFGS-B searches at a time can crash the program: "munmap_chunk(): invalid pointer"

    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        itk = self._itk
        spline = itk.BSplineTransformInitializer(reference, [_MESH, _MESH], 3)
        method = mean_squares(itk)
        method.SetOptimizerAsLBFGSB(
            gradientConvergenceTolerance=_FREE_FORM_TOLERANCE, numberOfIterations=_FREE_FORM_ITERATIONS
        )
        method.SetMovingInitialTransform(start)
        method.SetInitialTransform(spline, True)  # in place
        method.Execute(reference, subimage)
        field = itk.TransformToDisplacementFieldFilter()
        field.SetNumberOfThreads(1)
        field.SetReferenceImage(reference)
        return field.Execute(itk.CompositeTransform([start, spline]))


def _equally_bright(windows: Floats) -> Image:
    """Shift and scale windows (L, width, width) to mean 0 and a fixed standard deviation."""
    mean, contrast = (np.asarray(of(windows, axis=(1, 2), keepdims=True)) for of in (np.mean, np.std))
    return np.asarray(_CONTRAST * (windows - mean) / np.where(contrast > 0, contrast, 1.0), np.float32)
