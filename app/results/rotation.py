"""Rotation of the subimages: result variables, and sentences for the terminal and the window."""

import numpy as np

from app.results.view_quality import Variable, about
from reconstruction.registration.circulation import Circulation, measure_circulation
from reconstruction.wavefront import Wavefront

_LENSLET = ("lenslet_row", "lenslet_column")
ROTATES = (
    "the subimages rotate, which thin layers cannot cause: look for a cylinder lens, different magnifications"
    " along x and y, or a camera turned since the reference; keep registration.rotation = true"
)


def rotation_of(wavefront: Wavefront) -> Circulation | None:
    """Measure the rotation of the subimages; None with `registration.rotation = false`."""
    return measure_circulation(wavefront.displacement, wavefront.field.half_width_px(wavefront.sensor))


def rotation_variables(wavefront: Wavefront) -> dict[str, Variable]:
    """Return the rotation of the subimages as variables; none with `registration.rotation = false`."""
    found = rotation_of(wavefront)
    if found is None:
        return {}
    rotation = "rotation of the subimage, from +x to +y; NaN if lost or not shown by the source"
    chi_square = "reduced chi-square of the circulation of a typical lenslet; 0 if not shown by the source"
    return {
        "rotation": (_LENSLET, found.rotation_rad, about("rad", rotation)),
        "rotation_sigma": (_LENSLET, found.rotation_sigma_rad, about("rad", "standard deviation, noise only")),
        "rotation_significance": ((), np.array(found.significance), about("1", "mean rotation over its error")),
        "circulation_chi_square": ((), np.array(found.chi_square), about("1", chi_square)),
        "contradicts_layers": ((), np.array(found.contradicts_layers), about("1", "whether subimages rotate")),
    }


def rotation_sentence(found: Circulation) -> str:
    """Describe the rotation, as "rotation of the subimages: -3.53 +- 0.81 mrad, 4.4 times its error; ..."."""
    if not found.is_shown:
        return "rotation of the subimages: not shown by this source with this warp"
    return (
        f"rotation of the subimages: {found.mean_rad * 1e3:+z.2f} +- {found.mean_sigma_rad * 1e3:.2f} mrad,"
        f" {abs(found.significance):.1f} times its error; chi-square of their circulation {found.chi_square:.1f}"
    )
