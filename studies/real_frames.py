"""Compare lattices and displacements in public frames of real sensors with plain centroids: docs/real_frames.md.

    python -m studies.real_frames FOLDER

FOLDER holds checkouts of the repositories that the page names. The centroids use SciPy alone, not the package.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, spatial

from app.bench.config import Bench, load_bench
from app.images import read_image
from app.measurement.offline_reconstructor import OfflineReconstructor
from reconstruction.arrays import Floats
from reconstruction.geometry import Arrangement, Lattice
from reconstruction.lattice.search import Survey, survey

_BENCH = Path(__file__).parent / "real_frames.toml"
_REFERENCES, _SKY = Path("mmtwfs/mmtwfs/data/ref_images"), Path("mmtwfs/mmtwfs/data/test_data")
_GUV = Path("napari-LF/src/napari_lf/examples/GUVExperim1")
_SEEING_PX = 4.0  # standard deviation that makes the laboratory's spots as wide as those of the sky


@dataclass(frozen=True, kw_only=True)
class Case:
    """A frame and its sensor."""

    path: Path
    lenslets: tuple[int, int]  # rows, columns
    pitch_m: float
    pixel_m: float
    smooth_px: float = 1.0  # of the search for spots
    window: float = 0.6  # of the pitch, width of the window about a spot
    dark: Path | None = None
    arrangement: Arrangement = "square"

    def bench(self) -> Bench:
        """The page's bench with this sensor."""
        bench = load_bench(_BENCH)
        rows, columns = self.lenslets
        sensor = replace(
            bench.sensor,
            lenslet_rows=rows,
            lenslet_columns=columns,
            lenslet_pitch_m=self.pitch_m,
            pixel_pitch_m=self.pixel_m,
            arrangement=self.arrangement,
        )
        return replace(bench, sensor=sensor)


HECTO = Case(path=_REFERENCES / "f5_hecto_ref.fits", lenslets=(14, 14), pitch_m=600e-6, pixel_m=20e-6)
SKY = replace(HECTO, path=_SKY / "auto_wfs_0037_ave.fits", smooth_px=2.0)
SHACK = Case(path=Path("ShackHartmannAnalysis/demo/mainImage.png"), lenslets=(47, 65), pitch_m=150e-6, pixel_m=5.86e-6)
CASES = (
    Case(
        path=_GUV / "Radiometry_GUVExperim1.tif",
        dark=_GUV / "DarkFrame_GUVExperim1.tif",
        lenslets=(28, 28),
        pitch_m=100e-6,
        pixel_m=6.5e-6,
        smooth_px=2.0,
        window=0.95,
    ),
    Case(path=_REFERENCES / "LED2sec_22.fits", lenslets=(24, 24), pitch_m=400e-6, pixel_m=20e-6),
    Case(path=_REFERENCES / "binospec_ref.fits", lenslets=(20, 20), pitch_m=600e-6, pixel_m=26e-6),
    HECTO,
    Case(path=_REFERENCES / "mmirs_camera1_ref.fits", lenslets=(15, 15), pitch_m=600e-6, pixel_m=26e-6),
    Case(path=_REFERENCES / "mmirs_camera2_ref.fits", lenslets=(15, 15), pitch_m=600e-6, pixel_m=26e-6),
    SKY,
    Case(path=_REFERENCES / "f9_ref.fits", lenslets=(12, 12), pitch_m=625e-6, pixel_m=20e-6, arrangement="hexagonal"),
    Case(
        path=_REFERENCES / "f9_new_ref.fits",
        lenslets=(12, 12),
        pitch_m=625e-6,
        pixel_m=16.2e-6,
        arrangement="hexagonal",
    ),
)


def centroids(image: Floats, pitch_px: float, smooth_px: float, width: float) -> Floats:
    """Centres of gravity of the bright spots of an image (row, column), in windows of `width` pitches, (N, xy)."""
    smooth = ndimage.gaussian_filter(image, smooth_px)
    peaks = (smooth == ndimage.maximum_filter(smooth, int(pitch_px / 2))) & (smooth > np.median(smooth))
    height = smooth[peaks] - np.median(smooth)
    rows, columns = np.nonzero(peaks)
    bright = height > 0.25 * np.percentile(height, 95)
    half = int(width * pitch_px / 2)
    found = []
    for start in np.stack([rows, columns], axis=-1)[bright]:
        at = start.astype(np.float64)
        for _ in range(8):
            corner = np.rint(at).astype(int) - half
            window = image[corner[0] : corner[0] + 2 * half + 1, corner[1] : corner[1] + 2 * half + 1]
            if corner.min() < 0 or window.shape != (2 * half + 1,) * 2:
                break
            weight = window - np.percentile(window, 20)
            weight = np.where(weight > 0.2 * weight.max(), weight, 0)
            at = corner + np.array(ndimage.center_of_mass(weight))
        else:
            found.append(at[::-1])
    return np.array(found)


def lenslets_px(seen: Survey) -> Floats:
    """Positions of the light of the lit lenslets as the survey finds them, (N, xy)."""
    lattice, shape = seen.lattice, seen.illuminated.shape
    light = (
        lattice.lenslet_centers_px(*shape)
        + lattice.to_camera_px(seen.displacement_px)
        - [lattice.center_x_px, lattice.center_y_px]
    )
    return np.asarray(light[seen.illuminated])


def _nearest(among: Floats, position: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Distance and index of the nearest of some positions (N, xy) to each position (..., xy)."""
    away, index = spatial.cKDTree(among).query(position)
    return np.asarray(away), np.asarray(index)


def regular_lattice(position_px: Floats, near: Lattice) -> tuple[float, float]:
    """Pitch, px, and rotation, rad, of the lattice through positions (N, xy) by least squares, starting from `near`."""
    second = {"square": 1j, "hexagonal": np.exp(1j * np.pi / 3)}[near.arrangement]
    z = position_px @ [1, 1j]
    away = (z - z[len(z) // 2]) / (near.pitch_px * np.exp(1j * near.rotation_rad))
    along_second = np.rint(away.imag / second.imag)
    unit = np.rint(away.real - along_second * second.real) + along_second * second
    unit -= unit.mean()
    scale = complex(np.vdot(unit, z - z.mean()) / np.vdot(unit, unit).real)
    return abs(scale), float(np.angle(scale))


def compare(name: str, seen: Survey, truth_px: Floats) -> None:
    """Print the lattice found, the one of the true positions (N, xy), and how far the lenslets lie apart."""
    ours = lenslets_px(seen)
    away, nearest = _nearest(truth_px, ours)
    near = away < 0.3 * seen.lattice.pitch_px
    difference = ours[near] - truth_px[nearest[near]]
    lattices = [regular_lattice(position, seen.lattice) for position in (ours[near], truth_px[nearest[near]])]
    _write(
        f"{name:27} {near.sum():4} of {len(ours):4} lenslets | pitch found {seen.lattice.pitch_px:.4f}, by least"
        f" squares {lattices[0][0]:.4f}, truth {lattices[1][0]:.4f} px | rotation {lattices[0][1] * 1e3:+.3f}, truth"
        f" {lattices[1][1] * 1e3:+.3f} mrad | mean {np.abs(difference.mean(axis=0)).round(2)}, then"
        f" {rms(difference - difference.mean(axis=0)):.3f} px RMS apart"
    )


def zernikes(x: Floats, y: Floats) -> Floats:
    """Noll's Zernike polynomials 2 ... 10, unit RMS over the unit circle, (9, ...)."""
    r2 = x**2 + y**2
    second = [np.sqrt(3) * (2 * r2 - 1), np.sqrt(24) * x * y, np.sqrt(6) * (x**2 - y**2)]
    coma = [np.sqrt(8) * (3 * r2 - 2) * y, np.sqrt(8) * (3 * r2 - 2) * x]
    trefoil = [np.sqrt(8) * (3 * x**2 * y - y**3), np.sqrt(8) * (x**3 - 3 * x * y**2)]
    return np.stack([2 * x, 2 * y, *second, *coma, *trefoil])


def fitted(displacement_px: Floats, at_m: Floats, bench: Bench) -> Floats:
    """Zernike coefficients 2 ... 10, rad, by least squares of displacements (N, xy) at pupil positions (N, xy)."""
    sensor = bench.sensor
    radius_m, half_m = min(sensor.pupil_half_width_m), sensor.lenslet_pitch_m / 2
    nodes, weights = np.polynomial.legendre.leggauss(4)  # along an edge; exact for these
    design = np.zeros((len(at_m), 2, 9))
    for node, weight in zip(nodes * half_m, weights / 2, strict=True):
        for axis in (0, 1):
            edge = np.full(2, node)
            ends = []
            for side in (half_m, -half_m):
                edge[axis] = side
                ends.append(zernikes(*((at_m + edge).T / radius_m)))
            design[:, axis] += weight * (ends[0] - ends[1]).T / (2 * half_m)
    px_per_slope = sensor.lenslet_focal_length_m * sensor.wavelength_m / (2 * np.pi * sensor.pixel_pitch_m)
    found, *_ = np.linalg.lstsq(design.reshape(-1, 9) * px_per_slope, displacement_px.ravel(), rcond=None)
    return np.asarray(found)


def sky(folder: Path) -> None:
    """Print how a frame of the sky differs from plain centroids, in displacements and in Zernike coefficients."""
    bench = HECTO.bench()
    reference, frame = (read_image(folder / path).astype(np.float32) for path in (HECTO.path, SKY.path))
    blurred = np.asarray(ndimage.gaussian_filter(reference, _SEEING_PX))
    reconstructor = OfflineReconstructor(bench, blurred, full_scale=np.inf)
    wavefront = reconstructor(frame)
    lattice, sensor = reconstructor.bench.lattice, bench.sensor
    if lattice is None or wavefront.coefficients is None:
        raise ValueError("the bench of real frames must be modal")
    center_px = lattice.lenslet_centers_px(*HECTO.lenslets)
    spots = []
    for image, smooth_px in ((reference, HECTO.smooth_px), (frame, SKY.smooth_px)):
        found = centroids(image.astype(np.float64), lattice.pitch_px, smooth_px, HECTO.window)
        away_px, nearest = _nearest(found, center_px)
        spots.append(np.where((away_px < lattice.pitch_px / 2)[..., None], found[nearest], np.nan))
    truth = lattice.from_camera_px(spots[1] - spots[0] + [lattice.center_x_px, lattice.center_y_px])
    ours = wavefront.displacement.coefficients[:, :, 0]
    at_m = np.stack(np.meshgrid(sensor.pupil_x_m, sensor.pupil_y_m), axis=-1)
    inside = np.hypot(*np.moveaxis(at_m, -1, 0)) <= min(sensor.pupil_half_width_m)
    both = np.isfinite(truth).all(axis=-1) & wavefront.displacement.valid & inside
    difference = ours[both] - truth[both]
    _write(f"valid {wavefront.displacement.valid.sum()}, inside the circle and with both spots {both.sum()}")
    _write(f"displacements {rms(truth[both]):.2f} px RMS, differ by {rms(difference):.3f}")
    rest = rms(difference - difference.mean(axis=0))
    _write(f"mean difference {difference.mean(axis=0).round(3)} px; without it they differ by {rest:.3f}")
    rows = {"svwfs": wavefront.coefficients[1:, 0], "centroids": fitted(truth[both], at_m[both], bench)}
    for name, coefficients in rows.items():
        _write(f"{name:10}{''.join(f'{value:+9.2f}' for value in coefficients)} rad, Noll 2 ... 10")


def rms(vectors: Floats) -> float:
    """RMS length of vectors (N, xy)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def _write(text: str) -> None:
    sys.stdout.write(text + "\n")


def main(folder: Path) -> None:
    """Compare all frames in a folder of checkouts."""
    for case in CASES:
        image = read_image(folder / case.path).astype(np.float64)
        seen = survey(image, case.bench().sensor, dark=None if case.dark is None else read_image(folder / case.dark))
        compare(case.path.name, seen, centroids(image, seen.lattice.pitch_px, case.smooth_px, case.window))
    # The repository's own result: shifts, in half windows of 25 px, of the spots from a lattice of 48 x 66.
    shifts = np.load(folder / "ShackHartmannAnalysis/demo/output/moments_array.npy")[10:58]
    x, y = np.meshgrid(np.arange(79.421, 1738.5, 25.51), np.arange(27.45, 1227.4, 25.51))
    truth = np.stack([x, y], axis=-1) + 12.5 * shifts
    seen = survey(read_image(folder / SHACK.path), SHACK.bench().sensor)
    compare(SHACK.path.name, seen, truth[np.isfinite(truth).all(axis=-1)])
    sky(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
