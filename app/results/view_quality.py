"""What each view's wavefront does to an image, and how far one wavefront serves, as variables of a result."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.quality.image_quality import diffraction_rad, mtf, psf, psf_angles_rad
from reconstruction.quality.isoplanatism import StructureCurve, isoplanatism
from reconstruction.wavefront import Wavefront

Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]  # dimensions, values, attributes

_VIEW = ("view_row", "view_column")
_PSF_REACH = 16  # of the map's edge, in wavelengths over the pupil's width; the same for every frame


def about(units: str, long_name: str) -> dict[str, str]:
    """Attributes of a variable."""
    return {"units": units, "long_name": long_name}


def transfer(wavefront: Wavefront) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Modulation transfer of every view: variables and coordinates."""
    found = mtf(wavefront.views, wavefront.sensor)
    along_x, along_y = (*_VIEW, "frequency_x"), (*_VIEW, "frequency_y")
    return {
        "mtf_x": (along_x, found.along_x, about("1", "modulation transfer along x")),
        "mtf_y": (along_y, found.along_y, about("1", "modulation transfer along y")),
        "mtf_limit_x": (along_x, found.limit_x, about("1", "modulation transfer along x without aberration")),
        "mtf_limit_y": (along_y, found.limit_y, about("1", "modulation transfer along y without aberration")),
    }, {
        "frequency_x": (
            ("frequency_x",),
            found.frequency_x_per_rad,
            about("1/rad", "cycles per radian of field angle"),
        ),
        "frequency_y": (
            ("frequency_y",),
            found.frequency_y_per_rad,
            about("1/rad", "cycles per radian of field angle"),
        ),
    }


def structure(wavefront: Wavefront) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """How wavefronts differ over the field: variables and coordinates."""
    found = isoplanatism(wavefront)
    variables: dict[str, Variable] = {
        "global_error": ((), np.array(found.error_rad), about("rad", "RMS error of one wavefront for the whole field")),
        "global_error_without_tilt": (
            (),
            np.array(found.error_without_tilt_rad),
            about("rad", "the same, but for tip and tilt"),
        ),
        "global_error_view": (
            _VIEW,
            found.view_error_rad,
            about("rad", "RMS error of that one wavefront at each view"),
        ),
    }
    curves: dict[str, StructureCurve] = {"": found.curve, "_without_tilt": found.curve_without_tilt}
    for suffix, curve in curves.items():
        note = ", without tip and tilt" * bool(suffix)
        variables |= {
            f"structure_rms{suffix}": (
                ("separation",),
                curve.rms_rad,
                about("rad", f"RMS difference of two wavefronts{note}"),
            ),
            f"structure_least{suffix}": (("separation",), curve.least_rad, about("rad", f"least of all pairs{note}")),
            f"structure_most{suffix}": (("separation",), curve.most_rad, about("rad", f"most of all pairs{note}")),
            f"isoplanatic_patch{suffix}": (
                (),
                np.array(curve.patch_m),
                about("m", f"separation where the difference reaches 1 rad{note}; inf: it does not"),
            ),
        }
    separation = (("separation",), found.curve.separation_m, about("m", "of two positions in the field"))
    return variables, {"separation": separation}


def point_spread(wavefront: Wavefront) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Point-spread function of every view on a fixed grid of angles: variables and coordinates."""
    sensor = wavefront.sensor
    angle_rad = psf_angles_rad(sensor, _PSF_REACH * diffraction_rad(sensor))
    values = psf(wavefront.views, sensor, angle_rad=angle_rad).astype(np.float32)
    return {
        "psf": (
            (*_VIEW, "angle_y", "angle_x"),
            values,
            about("1", "point-spread function over its peak when unaberrated"),
        )
    }, {
        "angle_x": (("angle_x",), angle_rad, about("rad", "field angle along x")),
        "angle_y": (("angle_y",), angle_rad, about("rad", "field angle along y")),
    }
