"""From dense displacements to field modes, for the methods that find a displacement for every pixel.

A flow d(x) is the displacement, px, of the light at every pixel x of the reference's window: (L, N, xy). One matrix
for all lenslets yields the coefficients c_q.
"""

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Floats, Mask
from reconstruction.displacement import Displacement, Outcome, diagonal_covariance
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import FieldModes, SampledModes
from reconstruction.registration.classification import classify_lenslets
from reconstruction.registration.subimages import ReferenceSubimages

_MISFIT = 0.5  # residual over contrast above which the frame does not match


class FlowToModes:
    """Turns flows into coefficients of field modes by a prepared matrix."""

    def __init__(self, reference: ReferenceSubimages, modes: FieldModes) -> None:
        """Prepare for field modes.

        `SampledModes` take the flow at their nodes, bilinearly interpolated. Other modes are fitted by least squares
        over the field's square |x|, |y| <= 1.
        """
        self._reference, self._modes = reference, modes
        x, y = reference.offset_px.T / reference.half_width_px
        if isinstance(modes, SampledModes):
            self._matrix = _at_nodes(modes, reference.half_width_px, reference.width)
        else:
            inside = np.maximum(np.abs(x), np.abs(y)) <= 1
            self._matrix = np.zeros((modes.count, x.size))
            self._matrix[:, inside] = np.linalg.pinv(modes.values(x[inside], y[inside])).T
        # The variance of a translation, sigma^2 / sum |dI0/dx|^2, is that of a mean of N independent pixels.
        strength = np.sum(reference.gradient**2, axis=1)  # (L, xy)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = np.where(reference.lit[:, None], x.size / strength, 0.0)
        self._variance = pixel[:, :, None] * np.sum(self._matrix**2, axis=1)

    def __call__(self, flow: Floats, subimages: Floats, *, saturated: Mask) -> Displacement:
        """Convert the flow (L, N, xy), px, NaN where lost, of a frame's subimages (L, width, width).

        `saturated` (row, column) marks pixels at full scale.
        """
        reference = self._reference
        residual_rms, found = misfit(reference, subimages, flow)
        return classify_lenslets(
            reference,
            self._modes,
            np.swapaxes(self._matrix @ flow, 1, 2),
            covariance=diagonal_covariance(np.swapaxes(self._variance * residual_rms[:, None, None] ** 2, 1, 2)),
            residual_rms=residual_rms / reference.contrast.max(),
            contrast=subimages.std(axis=(1, 2)),
            faults={Outcome.DIVERGED: ~found, Outcome.SATURATED: reference.touched(saturated)},
        )


def _at_nodes(modes: SampledModes, half_width_px: float, width: int) -> Floats:
    """Bilinear weights of the window's pixels for the value at each node: (Q, N)."""
    along = [np.array(nodes) * half_width_px + (width - 1) / 2 for nodes in modes.nodes]
    if not all(np.all((position >= 0) & (position <= width - 1)) for position in along):
        raise ReconstructionError("the views lie outside the subimages: check the field's half_width_m and its views")
    x, y = (np.maximum(1 - np.abs(position[:, None] - np.arange(width)), 0) for position in along)
    return np.asarray(y[:, :, None] * x[:, None, :]).reshape(modes.count, -1)


def misfit(reference: ReferenceSubimages, subimages: Floats, flow: Floats) -> tuple[Floats, Mask]:
    """RMS of I0(x) - gain I1(x + d(x)) - offset over each window, counts, (L,), with the best gain and offset.

    subimages (L, width, width); flow (L, N, xy), px, NaN where lost, as is the RMS. Also the lenslets that match, (L,).
    """
    lenslets, width = len(subimages), reference.width
    position = flow + reference.offset_px + (width - 1) / 2
    known = np.isfinite(position).all(axis=(1, 2))
    lenslet = np.broadcast_to(np.arange(lenslets)[:, None], position.shape[:2])
    where = np.stack([lenslet, position[..., 1], position[..., 0]])[:, known]
    moved = ndimage.map_coordinates(subimages, where, order=1, mode="nearest")
    still = reference.light[known]
    moved, still = (image - image.mean(axis=1, keepdims=True) for image in (moved, still))
    power = np.sum(moved**2, axis=1)
    gain = np.sum(moved * still, axis=1) / np.where(power > 0, power, 1.0)
    residual_rms = np.full(lenslets, np.nan)
    residual_rms[known] = np.sqrt(np.mean((still - gain[:, None] * moved) ** 2, axis=1))
    return residual_rms, residual_rms < _MISFIT * reference.contrast
