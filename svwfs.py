"""Python interface of svwfs: wavefronts at every position of the field, from frames that are arrays.

>>> import svwfs
>>> bench = svwfs.load_bench("paper_simulation", "registration.warp=quadratic")
>>> bench.sensor.lenslet_rows
15

Arrays are NumPy arrays with `[row, column]`, row = y; vectors have (x, y) as their last axis; units are SI, wavefronts
are in rad without piston. Importing this module loads nothing but this file; each function loads what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from pathlib import Path

    import xarray as xr

    from app.acquisition.session import LiveBench
    from app.bench.config import Bench
    from app.errors import InputError, Interrupted, RunError
    from app.evaluation.frames import SimulatedFrames
    from app.measurement.bench_reconstructor import BenchReconstructor
    from app.measurement.measurement import Measurement
    from app.results.opened_recording import OpenedRecording
    from drivers.errors import (
        BadValue,
        Busy,
        DeviceError,
        DeviceTimeout,
        Disconnected,
        FrameLost,
        Unsupported,
        WrongState,
    )
    from reconstruction.arrays import Counts
    from reconstruction.deconvolution.corrected_image import PhaseAt
    from reconstruction.displacement import Displacement, Outcome
    from reconstruction.errors import ReconstructionError
    from reconstruction.geometry import Lattice
    from reconstruction.own_methods import OwnBasis, OwnRegistration
    from reconstruction.wavefront import Wavefront

_TYPES = {
    "BadValue": "drivers.errors",
    "Bench": "app.bench.config",
    "BenchReconstructor": "app.measurement.bench_reconstructor",
    "Busy": "drivers.errors",
    "DeviceError": "drivers.errors",
    "DeviceTimeout": "drivers.errors",
    "Disconnected": "drivers.errors",
    "Displacement": "reconstruction.displacement",
    "FrameLost": "drivers.errors",
    "InputError": "app.errors",
    "Interrupted": "app.errors",
    "Lattice": "reconstruction.geometry",
    "LiveBench": "app.acquisition.session",
    "Measurement": "app.measurement.measurement",
    "OpenedRecording": "app.results.opened_recording",
    "Outcome": "reconstruction.displacement",
    "ReconstructionError": "reconstruction.errors",
    "RunError": "app.errors",
    "SimulatedFrames": "app.evaluation.frames",
    "Unsupported": "drivers.errors",
    "Wavefront": "reconstruction.wavefront",
    "WrongState": "drivers.errors",
}

__all__ = [
    "BadValue",
    "Bench",
    "BenchReconstructor",
    "Busy",
    "DeviceError",
    "DeviceTimeout",
    "Disconnected",
    "Displacement",
    "FrameLost",
    "InputError",
    "Interrupted",
    "Lattice",
    "LiveBench",
    "Measurement",
    "OpenedRecording",
    "Outcome",
    "ReconstructionError",
    "RunError",
    "SimulatedFrames",
    "Unsupported",
    "Wavefront",
    "WrongState",
    "deconvolve",
    "field_coefficients",
    "find_corrector",
    "find_lattice",
    "find_layers",
    "live",
    "load_bench",
    "open_recording",
    "open_result",
    "psf",
    "reconstructor",
    "refine",
    "save_result",
    "simulate",
    "to_dataset",
]


def load_bench(source: str | Path, *overrides: str) -> Bench:
    """Read a bench from a TOML file or a preset.

    Parameters
    ----------
    source
        Path of a TOML file, or one of the presets `live_demo`, `small_demo`, `paper_simulation` and
        `paper_experiment`.
    *overrides
        Single settings as "section.key=value".

    Returns
    -------
    Bench
        The configuration, with the sections of the file as attributes; it cannot be changed.

    Raises
    ------
    InputError
        If the file or a setting cannot be used; the message names the key.

    Examples
    --------
    >>> import svwfs
    >>> svwfs.load_bench("live_demo", "camera.exposure_s=0.05").camera.exposure_s
    0.05
    """
    from app.bench.config import load_bench as load

    return load(source, overrides)


def simulate(bench: Bench, frames: int = 1, *, noise_free: bool = False) -> SimulatedFrames:
    """Simulate the images that the camera of a bench takes, with the true wavefronts.

    Parameters
    ----------
    bench
        The bench; its `[simulation]`, `[camera]` and `[light]` describe source, screen and detector.
    frames
        Number of frames with the sample. A drifting sample moves by one of its states from frame to frame.
    noise_free
        Return mean photons instead of counts.

    Returns
    -------
    SimulatedFrames
        `.reference` and `.dark` (row, column), `.frames` (frame, row, column), and `.truth` in rad (view_row,
        view_column, lenslet_row, lenslet_column), with a leading frame axis if the sample moves.

    Raises
    ------
    InputError
        If the bench cannot be rendered, or `frames` exceeds the states of a drifting sample.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench, frames=2)
    >>> images.frames.shape, images.truth.shape
    ((2, 240, 256), (3, 3, 7, 7))
    """
    from app.evaluation.frames import simulated_frames

    return simulated_frames(_bench(bench), frames, noise_free=noise_free)


def find_lattice(reference: Counts, bench: Bench, *, dark: Counts | None = None) -> Lattice:
    """Find the lenslets on a reference.

    Parameters
    ----------
    reference
        Frame without the sample, (row, column), counts.
    bench
        The bench; its `[sensor]` gives the number of lenslets and the designed pitch.
    dark
        Frame without light, (row, column), counts.

    Returns
    -------
    Lattice
        Centre and pitch in px, rotation in rad.

    Raises
    ------
    ReconstructionError
        If the frame shows no such lattice; the message says why.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> round(svwfs.find_lattice(images.reference, bench).pitch_px, 2)
    31.25
    """
    from app.measurement.bench_reconstructor import as_image
    from reconstruction.lattice.search import survey

    background = None if dark is None else as_image(dark, "dark")
    return survey(as_image(reference, "reference"), _bench(bench).sensor, dark=background).lattice


def reconstructor(
    bench: Bench,
    reference: Counts,
    *,
    dark: Counts | None = None,
    full_scale: float | None = None,
    frame: Counts | None = None,
    registration: OwnRegistration | None = None,
    basis: OwnBasis | None = None,
) -> BenchReconstructor:
    """Prepare the reconstruction of frames against a reference.

    The camera's noise, which weights lenslets and gives error bars, is estimated from reference and `frame`. Without
    `frame`, it is estimated when the first frame is reconstructed, as `svwfs reconstruct` does.

    Parameters
    ----------
    bench
        The bench. Without a `[lattice]`, the lattice is found in the reference.
    reference
        Frame without the sample, (row, column), counts.
    dark
        Frame without light, (row, column), counts. Without one, the darkest percent of each image is the background.
    full_scale
        Count at which a pixel saturates, such as 4095 for a 12-bit camera, infinite if none does; by default that of 16
        bits.
    frame
        Frame with the sample, (row, column), counts, that shows the camera's noise.
    registration
        Your registration method instead of the bench's: called with the subimages of a reference and the field, it
        returns a `RegistrationMethod` (docs/own_methods.md).
    basis
        Your pupil modes instead of the bench's: called with the sensor and their number or None, it returns
        `PupilModes` (docs/own_methods.md).

    Returns
    -------
    BenchReconstructor
        Call it with a frame (row, column) to get its `Wavefront`: `.views` in rad (view_row, view_column, lenslet_row,
        lenslet_column), `.at(x_m, y_m)` for numbers or arrays, `.sigma()`, `.coefficients`, `.displacement`.

    Raises
    ------
    ReconstructionError
        If reference, dark and bench do not go together, at the latest with the first frame; the message says why.
    InputError
        If the full scale is not positive.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    >>> wavefront = reconstruct(images.frames[0])
    >>> bool(abs(wavefront.views - images.truth).mean() < 0.1)  # rad
    True
    """
    from app.measurement.bench_reconstructor import BenchReconstructor
    from reconstruction.own_methods import OwnMethods

    own = OwnMethods(registration, basis)
    return BenchReconstructor(_bench(bench), reference, dark=dark, full_scale=full_scale, frame=frame, own=own)


def refine(reconstructor: BenchReconstructor, frame: Counts, rounds: int = 3) -> Wavefront:
    """Reconstruct a frame and remove the estimator's bias with the forward model of the bench.

    Parameters
    ----------
    reconstructor
        Result of `svwfs.reconstructor`; it keeps the model for the next frame.
    frame
        Frame with the sample, (row, column), counts.
    rounds
        Rounds of refinement at most, 0 or more; it ends early when a round no longer improves.

    Returns
    -------
    Wavefront
        The refined wavefront.

    Raises
    ------
    ReconstructionError
        If the frame cannot be reconstructed; the message says why.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    >>> wavefront = svwfs.refine(reconstruct, images.frames[0])
    >>> bool(abs(wavefront.views - images.truth).mean() < 0.05)  # rad
    True
    """
    wavefront = None
    for step in reconstructor.rounds(frame, rounds):
        wavefront = step.wavefront
    return wavefront or reconstructor(frame)


def psf(wavefront: Wavefront, x_m: float, y_m: float) -> xr.DataArray:
    """Point-spread function at one position of the field.

    Parameters
    ----------
    wavefront
        A reconstructed wavefront.
    x_m, y_m
        Field position, m.

    Returns
    -------
    xarray.DataArray
        Intensity (angle_y, angle_x) over the peak of the unaberrated pupil, so 1 is diffraction-limited and the value
        at angle 0 is the Strehl ratio; the coordinates are field angles in rad.

    Raises
    ------
    ValueError
        If the position lies outside the field.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> image = svwfs.psf(wavefront, x_m=0.0, y_m=0.5e-3)
    >>> image.dims
    ('angle_y', 'angle_x')
    """
    import xarray as xr

    from reconstruction.quality.image_quality import psf as point_spread
    from reconstruction.quality.image_quality import psf_angles_rad, psf_reach_rad

    phase, sensor = _wavefront(wavefront).at(x_m, y_m), wavefront.sensor
    angle_rad = psf_angles_rad(sensor, psf_reach_rad(phase, sensor))
    values = point_spread(phase, sensor, angle_rad=angle_rad)
    angles = {name: (name, angle_rad, {"units": "rad"}) for name in ("angle_y", "angle_x")}
    return xr.DataArray(values, dims=("angle_y", "angle_x"), coords=angles, name="psf")


def find_layers(
    reconstructor: BenchReconstructor, wavefront: Wavefront, count: int = 1, *, distances_m: tuple[float, ...] = ()
) -> xr.Dataset:
    """Find at which distance in front of the lenslets the aberration originates, or behind them (docs/layers.md).

    Parameters
    ----------
    reconstructor
        Result of `svwfs.reconstructor`.
    wavefront
        A wavefront made by it.
    count
        Number of layers to look for, 1 or 2.
    distances_m
        Known distances of the layers, negative behind the lenslets; found if omitted.

    Returns
    -------
    xarray.Dataset
        `distance_m(layer)` and `layer_phase(layer, y, x)` with their errors, `chi_square(distance)` and `misfit` of a
        single layer, `model_misfit(model)`; the attribute `verdict` says how many layers explain the wavefront, and `doubt`
        why that may be wrong.

    Raises
    ------
    ReconstructionError
        If too few lenslets are valid, or the displacements do not change over the field.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    >>> layers = svwfs.find_layers(reconstruct, reconstruct(images.frames[0]))
    >>> layers.attrs["verdict"]
    'one layer'
    >>> bool(abs(layers["distance_m"].item() - 0.195) < 0.005)  # as the bench says
    True
    """
    from app.results.layers import layers_dataset, ratio_at
    from reconstruction.layers.layer_search import find_layers as search

    ratios = tuple(ratio_at(distance_m, "lenslets", reconstructor.bench) for distance_m in distances_m)
    return layers_dataset(search(reconstructor.layers(_wavefront(wavefront)), count, at=ratios), reconstructor.bench)


def find_corrector(
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    modes: Literal["zernike", "legendre", "actuators"] = "zernike",
    count: int = 45,
    distance_m: float | None = None,
) -> xr.Dataset:
    """Find what a corrector conjugate to each distance would leave, and its best command (docs/layers.md).

    Parameters
    ----------
    source
        A wavefront, a file of results, or the folder of a recording, whose frames are averaged.
    bench
        The bench of the wavefront.
    modes
        Shapes that the corrector can take over its footprint.
    count
        Number of modes, the piston included, or of actuators, which is a square.
    distance_m
        Distance of the corrector in front of the lenslets, negative behind them; the best one if omitted.

    Returns
    -------
    xarray.Dataset
        `residual(distance)` in rad and `strehl(distance)` over the distance from the lenslets, `uncorrected` in rad;
        `corrector_distance_m`, `corrector_residual`, `command(shape)` and `command_phase(y, x)` in rad of one corrector.

    Raises
    ------
    InputError
        If source, modes or distance cannot be used; the message says why.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> found = svwfs.find_corrector(wavefront, bench)
    >>> bool(abs(found["corrector_distance_m"] - 0.195) < 0.01)  # that of the screen
    True
    >>> bool(found["corrector_residual"] < 0.1 * found["residual"].sel(distance=0))
    True
    """
    from app.errors import InputError
    from app.results.corrector import compare_correctors, correction_dataset
    from app.results.layers import ratio_at
    from reconstruction.layers.corrector import Corrector

    bench = _bench(bench)
    ratio = None if distance_m is None else ratio_at(distance_m, "lenslets", bench)
    phase_at = _phase_at(source, bench)
    try:
        made = compare_correctors(phase_at, bench.sensor, bench.field, Corrector(modes, count), ratio)
    except ValueError as error:
        raise InputError(str(error)) from error
    return correction_dataset(made, bench)


def field_coefficients(
    wavefront: Wavefront,
    basis: Literal["zernike", "legendre"] = "zernike",
    *,
    order: int | None = None,
    positions: int = 21,
) -> xr.Dataset:
    """Map the coefficients of a wavefront over the field, and write it in double Zernikes (docs/field.md).

    Parameters
    ----------
    wavefront
        A wavefront of the modal method.
    basis
        Zernike modes over the circle inscribed in the lattice, or Legendre modes over the whole lattice.
    order
        Highest degree of the modes; by default all that were fitted, which is exact.
    positions
        Number of field positions along each side.

    Returns
    -------
    xarray.Dataset
        `coefficient(mode, y, x)` and `coefficient_sigma` in rad, at field positions in m. With Zernike modes also
        `double_zernike(k, j)` and `double_zernike_sigma` in rad, and the radii of field and pupil, m, as attributes,
        named as the arguments of `galsim.zernike.DoubleZernike`.

    Raises
    ------
    ReconstructionError
        If the wavefront has no coefficients, or not of this order.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> field = svwfs.field_coefficients(wavefront, order=4)
    >>> field["coefficient"].sel(mode=4)["name"].item()  # Noll's count
    'Z4 defocus'
    """
    from app.results.coefficients import field_dataset
    from reconstruction.field_coefficients import ModalFit
    from reconstruction.field_coefficients import field_coefficients as coefficients

    found = coefficients(ModalFit.of(_wavefront(wavefront)), basis, order)
    return field_dataset(found, wavefront.sensor, wavefront.field, positions)


def deconvolve(
    image: Counts,
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    method: Literal["richardson-lucy", "wiener"] = "richardson-lucy",
    iterations: int = 50,
) -> xr.DataArray:
    """Remove the aberration of each field position from an image of the sample (docs/corrected_images.md).

    Parameters
    ----------
    image
        Counts, (row, column), taken through the same sample.
    source
        A wavefront, a file of results, or the folder of a recording, whose frames are averaged.
    bench
        The bench; its `[imaging]` has the scale of the image, and its pupil.
    method
        Richardson-Lucy keeps light positive; Wiener is faster.
    iterations
        At most; it ends earlier when only noise is left.

    Returns
    -------
    xarray.DataArray
        Corrected counts (row, column), float32, with the coordinate `inside`: True within the measured field, beyond
        which the image is as before. The attributes have `iterations` and `chi_square`.

    Raises
    ------
    InputError
        If image, wavefront and bench do not go together; the message says why.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo", "imaging.pixel_m=10e-6")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> image = images.frames[0]  # here your own image of the sample
    >>> corrected = svwfs.deconvolve(image, wavefront, bench, iterations=3)
    >>> corrected.shape, bool(corrected.inside.any())
    ((240, 256), True)
    """
    from app.measurement.bench_reconstructor import as_image
    from app.results.deconvolution import correct

    phase_at, bench = _phase_at(source, bench), _bench(bench)
    made = correct(as_image(image, "image"), phase_at, bench, method, iterations, lambda *_: None, name="image")
    return made["image"].rename(None).assign_coords(inside=made["inside"]).assign_attrs(units="counts", **made.attrs)


def to_dataset(wavefront: Wavefront) -> xr.Dataset:
    """Turn a wavefront into a dataset with names and units (docs/results.md).

    Parameters
    ----------
    wavefront
        A reconstructed wavefront.

    Returns
    -------
    xarray.Dataset
        `wavefront(view_row, view_column, lenslet_row, lenslet_column)` in rad with `wavefront_sigma`, displacements in
        px, coefficients in rad, image quality; every variable has its unit.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> svwfs.to_dataset(wavefront)["wavefront"].attrs["units"]
    'rad'
    """
    from app.results.dataset import result_dataset

    return result_dataset(_wavefront(wavefront))


def save_result(path: str | Path, wavefront: Wavefront, bench: Bench) -> None:
    """Write the dataset of a wavefront to a NetCDF file, with the bench as an attribute.

    Parameters
    ----------
    path
        The file, ending in .nc; it appears under its name only when it is complete.
    wavefront
        A reconstructed wavefront.
    bench
        The bench it was reconstructed with; `reconstructor.bench` includes the lattice.

    Raises
    ------
    InputError
        If the name is that of another format.
    RunError
        If the file cannot be written.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> svwfs.save_result("result.nc", wavefront, bench)
    """
    from pathlib import Path

    from app.files import check_suffix
    from app.results.dataset import result_dataset
    from app.results.result_file import write_results

    check_suffix(Path(path), ".nc")
    write_results(Path(path), result_dataset(_wavefront(wavefront)), bench=_bench(bench), inputs={})


def open_result(path: str | Path) -> xr.Dataset:
    """Open results that `svwfs reconstruct`, `measure`, `replay`, `batch` or `save_result` wrote.

    Parameters
    ----------
    path
        NetCDF file, or the Zarr store of `svwfs batch` (docs/many_machines.md).

    Returns
    -------
    xarray.Dataset
        The results; arrays are read when they are used. Close it, or use it in a `with` block.

    Raises
    ------
    InputError
        If the file or folder is missing, damaged, or holds no results.

    Examples
    --------
    >>> import svwfs
    >>> bench = svwfs.load_bench("small_demo")
    >>> images = svwfs.simulate(bench)
    >>> wavefront = svwfs.reconstructor(bench, images.reference, dark=images.dark)(images.frames[0])
    >>> svwfs.save_result("result.nc", wavefront, bench)
    >>> with svwfs.open_result("result.nc") as result:
    ...     result["rms"].dims
    ('view_row', 'view_column')
    """
    from pathlib import Path

    from app.batch.store import open_store
    from app.results.result_file import open_results

    return open_store(Path(path)) if Path(path).is_dir() else open_results(path)


def open_recording(path: str | Path) -> OpenedRecording:
    """Open a recording.

    Parameters
    ----------
    path
        Folder of the recording.

    Returns
    -------
    OpenedRecording
        `.frames` is a lazy array (frame, row, column) in counts with the coordinates `frame_index` and `time`;
        `.results()` is the dataset of all frames; `.bench`, `.dark`, `.reference` and `.run` are what it was made with.

    Raises
    ------
    InputError
        If the folder holds no recording.

    Examples
    --------
    >>> import svwfs
    >>> with svwfs.live(svwfs.load_bench("small_demo")) as bench:
    ...     folder = bench.record("recording", frames=3)
    >>> recording = svwfs.open_recording(folder)
    >>> recording.frames.sizes["frame"], recording.results().sizes["frame"]
    (3, 3)
    """
    from app.results.opened_recording import OpenedRecording

    return OpenedRecording(path)


def live(bench: Bench, *, average: int = 20) -> LiveBench:
    """Open the devices of a bench for a `with` block; iterate over it for measurements.

    Entering turns the light on, takes a dark and a reference, moves the sample in and starts the camera. Leaving stops
    the camera, turns the light off and closes the devices, also after an error. On a bench without motors, take the
    sample out, call `take_reference()`, put it in again, and call `note_sample_in()`.

    Parameters
    ----------
    bench
        The bench, simulated or real.
    average
        Number of frames averaged in the first dark and the first reference.

    Returns
    -------
    LiveBench
        Iterating yields the newest `Measurement`: `.wavefront`, or None with the reason in `.problem`; `.frame`;
        `.counts` of all frames. Methods: `take_dark`, `take_reference`, `auto_expose`, `set_exposure`, `set_em_gain`,
        `set_light`, `set_light_current`, `record(folder, frames)`.

    Raises
    ------
    DeviceError
        If a device is missing or fails.
    InputError
        If the bench cannot be used.

    Examples
    --------
    >>> import svwfs
    >>> with svwfs.live(svwfs.load_bench("small_demo")) as bench:
    ...     for measurement in bench:
    ...         break
    >>> measurement.wavefront.views.shape
    (3, 3, 7, 7)
    """
    from app.acquisition.session import LiveBench

    return LiveBench(_bench(bench), average=average)


def _bench(bench: object) -> Bench:
    """Refuse anything but a bench; a name is read."""
    from app.bench.config import Bench
    from app.errors import InputError

    if isinstance(bench, str):
        return load_bench(bench)
    if not isinstance(bench, Bench):
        raise InputError(f"a bench is needed, as load_bench returns it, not {type(bench).__name__}")
    return bench


def _phase_at(source: Wavefront | str | Path, bench: Bench) -> PhaseAt:
    """Return the wavefront at any field position, of a wavefront, a file of results or a recording."""
    from pathlib import Path

    from app.results.sources import mean_wavefront

    if isinstance(source, str | Path):
        return mean_wavefront(Path(source), _bench(bench), None, lambda *_: None)
    return _wavefront(source).at


def _wavefront(wavefront: object) -> Wavefront:
    """Refuse anything but a wavefront."""
    from app.errors import InputError
    from reconstruction.wavefront import Wavefront

    if not isinstance(wavefront, Wavefront):
        raise InputError(
            f"a wavefront is needed, not {type(wavefront).__name__}; Measurement.problem says why it is None"
        )
    return wavefront


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("svwfs")
    if name in _TYPES:
        return getattr(import_module(_TYPES[name]), name)
    raise AttributeError(f"module 'svwfs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
