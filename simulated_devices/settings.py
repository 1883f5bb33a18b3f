"""Settings of the simulated devices: `[simulation]`, and `[camera]` and `[light]` with driver "simulated"."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from annotated_types import Ge, Gt, Le
from typing_extensions import Doc

from drivers.interface import Range
from reconstruction.annotated_settings import Checked
from reconstruction.geometry import STAR_SPACING_M, STARS

Amplifier = Literal["normal", "em"]
_Noise = Annotated[float, Ge(0), Le(1e5)]  # electrons

Mask = Literal["square", "stars", "checkerboard", "optimised", "circle", "ellipse", "octagon", "peaks", "image"]
MASKS: tuple[Mask, ...] = get_args(Mask)

# From Hamamatsu's property sheet (propC9100-23B_en.html): the shortest exposure is the time of the read-out; only the
# fastest read-out limits the longest one.
_EXPOSURE_RANGE_S = {1: Range(0.42147, 7200.0), 2: Range(0.02713, 7200.0), 3: Range(0.0139, 1.0)}  # by read-out speed


def exposure_range_s(amplifier: Amplifier, readout_speed: int) -> Range:
    """Exposure times (s) that the C9100-23B allows; its normal amplifier always has read-out speed 1."""
    return _EXPOSURE_RANGE_S.get(1 if amplifier == "normal" else readout_speed, _EXPOSURE_RANGE_S[3])


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen(Checked):
    """The sample: a thin screen and its place."""

    correlation_length_m: Annotated[float, Ge(1e-6), Le(10), Doc("Sigma of the Gaussian that smooths noise")] = 2.0e-3
    rms_rad: Annotated[float, Ge(0), Le(1e4), Doc("Mean RMS over the views; with pv_rad, of the screen itself")] = 4.2
    pv_rad: Annotated[float, Gt(0), Le(1e5), Doc("Peak-to-valley of the screen itself")] | None = None
    file: Annotated[str, Doc("File of the screen, a .npy or .tif array of phases in rad, used unchanged")] = ""
    sample_spacing_m: Annotated[float, Ge(1e-9), Le(0.01)] = 25e-6
    samples: Annotated[int, Ge(8), Le(8192), Doc("Samples along each axis; more for a drift")] = 385
    placement: Literal["pupil", "source"] = "pupil"
    distance_m: Annotated[
        float, Ge(-100), Le(100), Doc("Distance before the lenslets (negative: behind), or after the mask")
    ] = 0.195
    transmission_rms: Annotated[float, Ge(0), Le(10), Doc("RMS of the transmission of mean 1; log-normal")] = 0.0
    transmission_correlation_length_m: Annotated[float, Ge(1e-6), Le(10), Doc("Sigma of the smoothing")] = 0.5e-3
    transmission_file: Annotated[str, Doc("File of transmission, 0 ... 1, .npy or .tif, sampled like the screen")] = ""
    drift_x_m_per_s: float = 0.0
    drift_y_m_per_s: float = 0.0

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.pv_rad is not None and not self.pv_rad > 2 * self.rms_rad > 0:
            yield "pv_rad", f"must be more than {2 * self.rms_rad:g} rad, twice rms_rad"
        if self.placement == "source" and self.distance_m < 0:
            yield "distance_m", 'must be 0 or more with placement = "source"'

    @property
    def is_drifting(self) -> bool:
        """True if the screen moves."""
        return self.drift_x_m_per_s != 0 or self.drift_y_m_per_s != 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Source(Checked):
    """Masks in front of the light: openings, an array of pinholes (the stars) and grey transparencies."""

    mask: Annotated[Mask, Doc("Mask at the start")] = "square"
    half_width_m: Annotated[
        float, Ge(1e-6), Le(0.1), Doc("Half width of square, circle and octagon; of the ellipse along x")
    ] = 0.6e-3
    checker_cells: Annotated[int, Ge(2), Le(100), Doc("Cells of the checkerboard along each side of the square")] = 6
    ellipse_ratio: Annotated[float, Gt(0), Le(1), Doc("Width of the ellipse along y over its width along x")] = 0.6
    file: Annotated[str, Doc('File of the mask "image": a grey image (TIFF, NPY, PNG) that fills the square')] = ""
    star_rows: Annotated[int, Ge(1), Le(99)] = STARS
    star_columns: Annotated[int, Ge(1), Le(99)] = STARS
    star_spacing_m: Annotated[float, Gt(0), Le(0.1)] = STAR_SPACING_M
    pinhole_diameter_m: Annotated[float, Ge(0), Le(0.01), Doc("Pinhole diameter; 0: points as bright as 50 um")] = 50e-6

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.mask not in self.masks:
            yield "mask", '= "image" needs a file'

    @property
    def masks(self) -> tuple[Mask, ...]:
        """Available masks; "image" only with a file."""
        return tuple(mask for mask in MASKS if mask != "image" or self.file)


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation(Checked):
    """Accuracy of the simulation, its sample and its source."""

    seed: Annotated[int, Ge(0), Le(2**63 - 1)] = 1
    object_samples: Annotated[int, Ge(2), Le(1001), Doc("Points along a side of the square source")] = 37
    pupil_samples: Annotated[int, Ge(4), Le(256), Doc("Samples of the pupil across a lenslet")] = 20
    border_lenslets: Annotated[int, Ge(0), Le(20), Doc("Illuminated rings of lenslets around the evaluated ones")] = 0
    drifting_states: Annotated[int, Ge(2), Le(10000), Doc("Positions of a drifting screen, back and forth")] = 48
    state_duration_s: Annotated[float, Ge(1e-3), Le(1e6), Doc("Duration of each position of a drifting screen")] = 0.1
    screen: Screen = field(default_factory=Screen)
    source: Source = field(default_factory=Source)

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.pupil_samples % 2:
            yield "pupil_samples", "must be even"

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of screen, transmission and mask, if there are any."""
        files = self.screen.file, self.screen.transmission_file, self.source.file
        return tuple(Path(file) for file in files if file)


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedCameraSettings(Checked):
    """Electron-multiplying camera, by default like a Hamamatsu C9100-23B, air-cooled to -65 degC."""

    driver: Literal["simulated"] = "simulated"
    rows: Annotated[int, Ge(8), Le(8192)] = 512
    columns: Annotated[int, Ge(8), Le(8192)] = 512
    exposure_s: Annotated[float, Ge(1e-4), Le(7200), Doc("Exposure; range by amplifier and speed")] = 1 / 70
    shortest_exposure_s: (
        Annotated[float, Ge(1e-4), Le(1), Doc("Frame period of a faster camera, in place of the readout time")] | None
    ) = None
    noise_frames: Annotated[
        int, Ge(0), Le(100), Doc("Frames of each image, repeated at the cost of a copy; 0: each frame has new noise")
    ] = 0
    amplifier: Amplifier = "em"
    readout_speed: Annotated[int, Ge(1), Le(3), Doc("Readout speed; 1 with the normal amplifier")] = 3
    em_gain: Annotated[float, Ge(1), Le(1e5)] = 1.0
    maximum_em_gain: Annotated[float, Ge(1), Le(1e5)] = 1200.0
    quantum_efficiency: Annotated[float, Gt(0), Le(1), Doc("Quantum efficiency at 462 nm")] = 0.8
    dark_current_e_per_s: Annotated[float, Ge(0), Le(1e6)] = 0.005
    clock_induced_charge_e: Annotated[float, Ge(0), Le(1e3), Doc("Spurious charge per pixel and frame")] = 0.0015
    em_read_noise_e: Annotated[
        tuple[_Noise, _Noise, _Noise], Doc("Read noise of the EM amplifier at speed 1, 2, 3")
    ] = (8.0, 25.0, 37.0)
    normal_read_noise_e: Annotated[float, Ge(0), Le(1e5)] = 10.0
    full_well_e: Annotated[float, Ge(1), Le(1e9)] = 370e3
    register_full_well_e: Annotated[float, Ge(1), Le(1e9), Doc("Full well of the multiplication register")] = 800e3
    electrons_per_count: Annotated[float, Ge(1e-4), Le(1e4)] = 5.8
    nonlinearity: Annotated[float, Ge(-0.5), Le(0.5), Doc("Share of a signal at full scale that is lost")] = 0.0
    offset_counts: Annotated[float, Ge(0), Le(65535)] = 500.0
    bits: Annotated[int, Ge(8), Le(16)] = 16
    pixel_fill_factor: Annotated[float, Ge(0), Le(1), Doc("Sensitive width of a pixel over its pitch")] = 1.0

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        allowed = self.exposure_range_s(self.amplifier, self.readout_speed)
        if not allowed.minimum <= self.exposure_s <= allowed.maximum:
            limits = f"{allowed.minimum:.3g} ... {allowed.maximum:g}"
            yield "exposure_s", f"must be {limits} s with this amplifier and speed"
        if self.em_gain > self.maximum_em_gain:
            yield "em_gain", f"must be 1 ... {self.maximum_em_gain:g} (maximum_em_gain)"
        if self.em_gain != 1 and self.amplifier != "em":
            yield "em_gain", 'needs amplifier = "em"'

    def exposure_range_s(self, amplifier: Amplifier, readout_speed: int) -> Range:
        """Exposure times (s) that the camera allows."""
        allowed = exposure_range_s(amplifier, readout_speed)
        return allowed if self.shortest_exposure_s is None else Range(self.shortest_exposure_s, allowed.maximum)

    @property
    def loss_per_e(self) -> float:
        """Share that the nonlinearity takes of one electron's signal, for each electron with it."""
        return self.nonlinearity / (self.electrons_per_count * (2.0**self.bits - 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedLightSettings(Checked):
    """An LED behind the mask; its light is proportional to its current."""

    driver: Literal["simulated"] = "simulated"
    current_a: Annotated[float, Ge(0), Le(1e3)] = 0.35
    maximum_current_a: Annotated[float, Ge(1e-15), Le(1e3)] = 1.0
    wavelengths_m: Annotated[
        tuple[Annotated[float, Ge(1e-7), Le(1e-4)], ...],
        Doc("Wavelengths of a broad LED, around sensor.wavelength_m; none: that alone"),
    ] = ()
    weights: Annotated[
        tuple[Annotated[float, Ge(0), Le(1e12)], ...], Doc("Weight of each wavelength for the camera; none: all alike")
    ] = ()

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.weights and len(self.weights) != len(self.wavelengths_m):
            yield "weights", f"must be as many as wavelengths_m, {len(self.wavelengths_m)}"
        if self.weights and not sum(self.weights) > 0:
            yield "weights", "must not all be 0"
        if self.current_a > self.maximum_current_a:
            yield "current_a", f"must be 0 ... {self.maximum_current_a:g} A (maximum_current_a)"

    @property
    def lines(self) -> tuple[tuple[float, float], ...]:
        """Wavelength (m) and share of the light of each line that shines; none without `wavelengths_m`."""
        weights = self.weights or (1.0,) * len(self.wavelengths_m)
        total = sum(weights)
        lines = zip(self.wavelengths_m, weights, strict=True)
        return tuple((length_m, weight / total) for length_m, weight in lines if weight > 0)
