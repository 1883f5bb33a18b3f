"""Image quality of each view and range of one wavefront, as variables of a result."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.quality.image_quality import diffraction_rad, mtf, psf, psf_angles_rad
from reconstruction.quality.isoplanatism import isoplanatism
from reconstruction.wavefront import Wavefront

Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]  # dimensions, values, attributes

_VIEW = ("view_row", "view_column")
_PSF_REACH = 16  # half width of the map in diffraction widths (wavelength / pupil width), equal for all frames


def about(units: str, long_name: str) -> dict[str, str]:
    """Attributes of a variable."""
    return {"units": units, "long_name": long_name}


def transfer(wavefront: Wavefront) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Modulation transfer of every view: variables and coordinates."""
    found = mtf(wavefront.views, wavefront.sensor)
    variables: dict[str, Variable] = {}
    for axis, values, limit in (("x", found.along_x, found.limit_x), ("y", found.along_y, found.limit_y)):
        dimensions, name = (*_VIEW, f"frequency_{axis}"), f"modulation transfer along {axis}"
        variables[f"mtf_{axis}"] = dimensions, values, about("1", name)
        variables[f"mtf_limit_{axis}"] = dimensions, limit, about("1", f"{name} without aberration")
    frequency = about("1/rad", "cycles per radian of field angle")
    return variables, {
        "frequency_x": (("frequency_x",), found.frequency_x_per_rad, frequency),
        "frequency_y": (("frequency_y",), found.frequency_y_per_rad, frequency),
    }


def structure(wavefront: Wavefront) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Differences of wavefronts over the field: variables and coordinates."""
    found = isoplanatism(wavefront)
    error, without_tilt = np.array(found.error_rad), np.array(found.error_without_tilt_rad)
    at_views = about("rad", "RMS error of that one wavefront at each view")
    variables: dict[str, Variable] = {
        "global_error": ((), error, about("rad", "RMS error of one wavefront for the whole field")),
        "global_error_without_tilt": ((), without_tilt, about("rad", "the same, but for tip and tilt")),
        "global_error_view": (_VIEW, found.view_error_rad, at_views),
    }
    for suffix, curve in (("", found.curve), ("_without_tilt", found.curve_without_tilt)):
        note = ", without tip and tilt" * bool(suffix)
        patch = f"separation where the difference reaches 1 rad{note}; inf: it does not"
        for name, values, long_name in (
            ("rms", curve.rms_rad, "RMS difference of two wavefronts"),
            ("least", curve.least_rad, "least of all pairs"),
            ("most", curve.most_rad, "most of all pairs"),
        ):
            variables[f"structure_{name}{suffix}"] = ("separation",), values, about("rad", long_name + note)
        variables[f"isoplanatic_patch{suffix}"] = (), np.array(curve.patch_m), about("m", patch)
    separation = (("separation",), found.curve.separation_m, about("m", "of two positions in the field"))
    return variables, {"separation": separation}


def point_spread(wavefront: Wavefront) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Point-spread function of every view on a fixed grid of angles: variables and coordinates."""
    sensor = wavefront.sensor
    angle_rad = psf_angles_rad(sensor, _PSF_REACH * diffraction_rad(sensor))
    values = psf(wavefront.views, sensor, angle_rad=angle_rad).astype(np.float32)
    ideal = about("1", "point-spread function over its peak when unaberrated")
    return {"psf": ((*_VIEW, "angle_y", "angle_x"), values, ideal)}, {
        "angle_x": (("angle_x",), angle_rad, about("rad", "field angle along x")),
        "angle_y": (("angle_y",), angle_rad, about("rad", "field angle along y")),
    }
