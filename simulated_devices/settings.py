"""Settings of the simulated devices: `[simulation]`, and `[camera]` and `[light]` with driver "simulated".

Each class checks itself; the sentence of a `ValueError` begins with the name of the wrong key.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from drivers.interface import Range
from reconstruction.geometry import require

Amplifier = Literal["normal", "em"]

Mask = Literal["square", "stars", "checkerboard", "circle", "ellipse", "octagon", "peaks", "image"]
MASKS: tuple[Mask, ...] = get_args(Mask)

# From Hamamatsu's property sheet (propC9100-23B_en.html): the shortest exposure is the time of the read-out; only the
# fastest read-out limits the longest one.
_EXPOSURE_RANGE_S: dict[tuple[Amplifier, int], Range] = {
    ("em", 3): Range(0.0139, 1.0),
    ("em", 2): Range(0.02713, 7200.0),
    ("em", 1): Range(0.42147, 7200.0),
    ("normal", 1): Range(0.42147, 7200.0),
}


def exposure_range_s(amplifier: Amplifier, readout_speed: int) -> Range:
    """Exposure times (s) that the C9100-23B allows; its normal amplifier always has read-out speed 1."""
    return _EXPOSURE_RANGE_S["normal", 1] if amplifier == "normal" else _EXPOSURE_RANGE_S["em", readout_speed]


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """The sample: a thin screen and its place."""

    correlation_length_m: float = 2.0e-3  # sigma of the Gaussian that smooths white noise
    rms_rad: float = 4.2  # mean over the views of the wavefront's RMS; of the screen itself where pv_rad is given
    pv_rad: float | None = None  # peak to valley of the screen itself, with rms_rad as its RMS
    file: str = ""  # a .npy or .tif array of phases in rad, used unchanged
    sample_spacing_m: float = 25e-6
    samples: int = 385  # along each axis; a larger footprint or a drift makes the generated screen larger
    placement: Literal["pupil", "source"] = "pupil"
    distance_m: float = 0.195  # before the lenslets ("pupil"; negative: behind them) or after the mask ("source")
    transmission_rms: float = 0.0  # of the intensity that passes, relative to its mean, which counts as 1; log-normal
    transmission_correlation_length_m: float = 0.5e-3  # sigma of the Gaussian that smooths its logarithm
    transmission_file: str = ""  # a .npy or .tif array of transmitted intensity, 0 ... 1, sampled like the screen
    drift_x_m_per_s: float = 0.0
    drift_y_m_per_s: float = 0.0

    def __post_init__(self) -> None:
        require(
            {
                "correlation_length_m must be 1e-6 ... 10": 1e-6 <= self.correlation_length_m <= 10,
                "rms_rad must be 0 ... 1e4": 0 <= self.rms_rad <= 1e4,
                "pv_rad must be positive, at most 1e5": self.pv_rad is None or 0 < self.pv_rad <= 1e5,
                "pv_rad must be more than twice rms_rad": self.pv_rad is None or self.pv_rad > 2 * self.rms_rad > 0,
                "sample_spacing_m must be 1e-9 ... 0.01": 1e-9 <= self.sample_spacing_m <= 0.01,
                "samples must be 8 ... 8192": 8 <= self.samples <= 8192,
                'placement must be "pupil" or "source"': self.placement in {"pupil", "source"},
                "distance_m must be -100 ... 100": -100 <= self.distance_m <= 100,
                'distance_m must be 0 or more with placement = "source"': (
                    self.placement == "pupil" or self.distance_m >= 0
                ),
                "transmission_rms must be 0 ... 10": 0 <= self.transmission_rms <= 10,
                "transmission_correlation_length_m must be 1e-6 ... 10": (
                    1e-6 <= self.transmission_correlation_length_m <= 10
                ),
                "drift_x_m_per_s must be finite": math.isfinite(self.drift_x_m_per_s),
                "drift_y_m_per_s must be finite": math.isfinite(self.drift_y_m_per_s),
            }
        )

    @property
    def is_drifting(self) -> bool:
        """True if the screen moves."""
        return self.drift_x_m_per_s != 0 or self.drift_y_m_per_s != 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """Masks in front of the light: openings, an array of pinholes (the stars) and grey transparencies."""

    mask: Mask = "square"  # the initial one
    half_width_m: float = 0.6e-3  # of the square, the circle and the octagon; along x, of the ellipse
    checker_cells: int = 6  # of the checkerboard that fills the square, along each side
    ellipse_ratio: float = 0.6  # the ellipse's width along y over that along x
    file: str = ""  # a grey image (TIFF, NPY, PNG) that fills the square: the mask "image"
    star_rows: int = 3
    star_columns: int = 3
    star_spacing_m: float = 0.5e-3
    pinhole_diameter_m: float = 50e-6  # 0: each star is one point with the light of a 50 um pinhole

    def __post_init__(self) -> None:
        require(
            {
                f"mask must be one of {', '.join(MASKS)}": self.mask in MASKS,
                'mask = "image" needs a file': self.mask in self.masks,
                "half_width_m must be 1e-6 ... 0.1": 1e-6 <= self.half_width_m <= 0.1,
                "checker_cells must be 2 ... 100": 2 <= self.checker_cells <= 100,
                "ellipse_ratio must be above 0 and at most 1": 0 < self.ellipse_ratio <= 1,
                "star_rows must be 1 ... 99": 1 <= self.star_rows <= 99,
                "star_columns must be 1 ... 99": 1 <= self.star_columns <= 99,
                "star_spacing_m must be positive, at most 0.1": 0 < self.star_spacing_m <= 0.1,
                "pinhole_diameter_m must be 0 ... 0.01": 0 <= self.pinhole_diameter_m <= 0.01,
            }
        )

    @property
    def masks(self) -> tuple[Mask, ...]:
        """Available masks; "image" only with a file."""
        return tuple(mask for mask in MASKS if mask != "image" or self.file)


@dataclass(frozen=True, slots=True, kw_only=True)
class Simulation:
    """Accuracy of the simulation, its sample and its source."""

    seed: int = 1
    object_samples: int = 37  # points along a side of the square source
    pupil_samples: int = 20  # across a lenslet
    border_lenslets: int = 0  # rings of lenslets around the evaluated ones, lit and imaged too
    drifting_states: int = 48  # positions of a drifting screen, played back and forth
    state_duration_s: float = 0.1  # time for which each is shown
    screen: Screen = field(default_factory=Screen)
    source: Source = field(default_factory=Source)

    def __post_init__(self) -> None:
        require(
            {
                "seed must be 0 ... 2**63 - 1": 0 <= self.seed < 2**63,
                "object_samples must be 2 ... 1001": 2 <= self.object_samples <= 1001,
                "pupil_samples must be even, 4 ... 256": 4 <= self.pupil_samples <= 256 and self.pupil_samples % 2 == 0,
                "border_lenslets must be 0 ... 20": 0 <= self.border_lenslets <= 20,
                "drifting_states must be 2 ... 10000": 2 <= self.drifting_states <= 10000,
                "state_duration_s must be 1e-3 ... 1e6": 1e-3 <= self.state_duration_s <= 1e6,
            }
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of screen, transmission and mask, if there are any."""
        files = self.screen.file, self.screen.transmission_file, self.source.file
        return tuple(Path(file) for file in files if file)


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedCameraSettings:
    """Electron-multiplying camera; the defaults are typical of a Hamamatsu C9100-23B, air-cooled to -65 degC."""

    driver: Literal["simulated"] = "simulated"
    rows: int = 512
    columns: int = 512
    exposure_s: float = 1 / 70
    amplifier: Amplifier = "em"
    readout_speed: int = 3  # of the EM amplifier; the normal one has speed 1 only
    em_gain: float = 1.0
    maximum_em_gain: float = 1200.0
    quantum_efficiency: float = 0.8  # at 462 nm
    dark_current_e_per_s: float = 0.005
    clock_induced_charge_e: float = 0.0015  # per pixel and frame
    em_read_noise_e: tuple[float, float, float] = (8.0, 25.0, 37.0)  # at read-out speed 1, 2, 3
    normal_read_noise_e: float = 10.0
    full_well_e: float = 370e3
    register_full_well_e: float = 800e3  # of the multiplication register
    electrons_per_count: float = 5.8
    offset_counts: float = 500.0
    bits: int = 16
    pixel_fill_factor: float = 1.0  # width of the sensitive square over the pitch; 0: the image at the centres

    def __post_init__(self) -> None:
        speed_is_known = self.readout_speed in {1, 2, 3}
        allowed = exposure_range_s(self.amplifier, self.readout_speed if speed_is_known else 3)
        noises = (*self.em_read_noise_e, self.normal_read_noise_e)
        require(
            {
                "rows must be 8 ... 8192": 8 <= self.rows <= 8192,
                "columns must be 8 ... 8192": 8 <= self.columns <= 8192,
                'amplifier must be "normal" or "em"': self.amplifier in {"normal", "em"},
                "readout_speed must be 1, 2 or 3": speed_is_known,
                f"exposure_s must be {allowed.minimum:g} ... {allowed.maximum:g} with this amplifier and speed": (
                    allowed.minimum <= self.exposure_s <= allowed.maximum
                ),
                "maximum_em_gain must be 1 ... 1e5": 1 <= self.maximum_em_gain <= 1e5,
                "em_gain must be 1 ... maximum_em_gain": 1 <= self.em_gain <= self.maximum_em_gain,
                'em_gain needs amplifier = "em"': self.amplifier == "em" or self.em_gain == 1,
                "quantum_efficiency must be above 0 and at most 1": 0 < self.quantum_efficiency <= 1,
                "dark_current_e_per_s must be 0 ... 1e6": 0 <= self.dark_current_e_per_s <= 1e6,
                "clock_induced_charge_e must be 0 ... 1e3": 0 <= self.clock_induced_charge_e <= 1e3,
                "em_read_noise_e and normal_read_noise_e must be 0 ... 1e5": all(0 <= e <= 1e5 for e in noises),
                "full_well_e must be 1 ... 1e9": 1 <= self.full_well_e <= 1e9,
                "register_full_well_e must be 1 ... 1e9": 1 <= self.register_full_well_e <= 1e9,
                "electrons_per_count must be 1e-4 ... 1e4": 1e-4 <= self.electrons_per_count <= 1e4,
                "pixel_fill_factor must be 0 ... 1": 0 <= self.pixel_fill_factor <= 1,
                "bits must be 8 ... 16": 8 <= self.bits <= 16,
                "offset_counts must lie on the camera's scale": (
                    0 <= self.offset_counts < 2 ** min(max(self.bits, 0), 16)
                ),
            }
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedLightSettings:
    """An LED behind the mask; its light is proportional to its current."""

    driver: Literal["simulated"] = "simulated"
    current_a: float = 0.35
    maximum_current_a: float = 1.0

    def __post_init__(self) -> None:
        require(
            {
                "maximum_current_a must be 1e-15 ... 1e3": 1e-15 <= self.maximum_current_a <= 1e3,
                "current_a must be 0 ... maximum_current_a": 0 <= self.current_a <= self.maximum_current_a,
            }
        )
