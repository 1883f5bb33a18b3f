"""Tool tips of the settings that can be automatic: what was chosen now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from app.bench.config import AUTOMATIC
from reconstruction.settings import FIELD_MODES

if TYPE_CHECKING:
    from app.gui.controls_panel import ControlsPanel
    from reconstruction.wavefront import Wavefront

WARP_TIP = (
    "Allowed distortion of a subimage: shift (translation), affine, quadratic, cubic or quartic.\n"
    "Subimages rotate only if the bench says registration.rotation = true.\n"
    "More freedom resolves finer changes over the field. Most other methods ignore this"
)
MODES_TIP = (
    "Number of pupil modes that the modal method fits, at most one for each lenslet;\n"
    "automatic (or 0): as many as the lattice supports, smoothed according to the noise"
)


def show_automatic(controls: ControlsPanel, wavefront: Wavefront | None) -> None:
    """Tell in the tool tips of warp and modes what was chosen automatically for a wavefront."""
    warp, modes = WARP_TIP, MODES_TIP
    if wavefront is not None and controls.warp.isEnabled() and controls.warp.currentText() == AUTOMATIC:
        fields = wavefront.displacement.modes.count
        warp += "".join(f"\n\nChosen now: {name}" for name, count in FIELD_MODES.items() if count == fields)
    if wavefront is not None and controls.pupil_modes.isEnabled() and controls.pupil_modes.text() == AUTOMATIC:
        modes += "" if wavefront.coefficients is None else f"\n\nChosen now: {len(wavefront.coefficients)}"
    controls.warp.setToolTip(warp)
    controls.pupil_modes.setToolTip(modes)
