"""Tool tips of the settings that can be automatic: what was chosen now."""

from app.bench.config import AUTOMATIC
from app.gui.number_field import NumberField
from app.gui.widgets import Choice
from reconstruction.settings import FIELD_MODES
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


def show_automatic(warp: Choice, modes: NumberField, wavefront: Wavefront | None) -> None:
    """Tell in the tool tips what was chosen automatically for a wavefront."""
    of_warp, of_modes = WARP_TIP, MODES_TIP
    if wavefront is not None and warp.isEnabled() and warp.currentText() == AUTOMATIC:
        fields = wavefront.displacement.modes.count
        of_warp += "".join(f"\n\nChosen now: {name}" for name, count in FIELD_MODES.items() if count == fields)
    if wavefront is not None and modes.isEnabled() and modes.text() == AUTOMATIC:
        of_modes += "" if wavefront.coefficients is None else f"\n\nChosen now: {len(wavefront.coefficients)}"
    warp.setToolTip(of_warp)
    modes.setToolTip(of_modes)
