"""Formats of exported recordings. This file loads nothing else, so that the help of the program is fast."""

from typing import Literal

Format = Literal["tiff", "csv", "netcdf", "psf", "double-zernike", "zernike-table"]

FORMATS: dict[Format, tuple[str, tuple[str, ...]]] = {  # what is written, and the suffixes of its file
    "tiff": ("Frames as TIFF", (".tif", ".tiff")),
    "csv": ("RMS and coefficients as CSV", (".csv",)),
    "netcdf": ("All results as NetCDF", (".nc",)),
    "psf": ("Point-spread functions as TIFF", (".tif", ".tiff")),
    "double-zernike": ("Double Zernikes as NetCDF, for GalSim", (".nc",)),
    "zernike-table": ("Zernike coefficients of each view as CSV", (".csv",)),
}
