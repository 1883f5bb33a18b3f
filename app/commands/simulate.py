"""`svwfs simulate`: simulated frames and the true wavefronts as files."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.acquisition.devices import simulated_bench
from app.bench.config import Bench
from app.images import write_image
from app.results.dataset import truth_dataset
from app.results.result_file import write_results
from simulated_devices.bench import SimulatedBench
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock
from simulated_devices.sample import scintillation

_CONDITIONS = {"dark": (False, False), "reference": (True, False), "frame": (True, True)}  # light on, sample in
_TRUTH = "truth.nc"


def files_of(out: Path) -> list[Path]:
    """Return the files that `simulate` writes."""
    return [out / name for name in (*(f"{name}.tif" for name in _CONDITIONS), _TRUTH)]


def simulate(bench: Bench, out: Path, *, noise_free: bool, progress: Callable[[float], None]) -> float:
    """Write `dark.tif`, `reference.tif`, `frame.tif` and `truth.nc` into the folder `out`.

    The images are camera counts or, with `noise_free`, mean photons per pixel as float32. Returns the scintillation,
    the RMS of the light at the lenslets about that without sample, relative to it.
    """
    with closing(simulated_bench(bench, progress, ManualClock())) as simulated, SimulatedCamera(simulated) as camera:
        state: int | None = None
        for name, (light_on, sample_in) in _CONDITIONS.items():
            simulated.change(is_light_on=light_on, is_sample_in=sample_in)
            image, state = _mean_photons(simulated, camera) if noise_free else _frame(camera)
            write_image(out / f"{name}.tif", image)
        light = simulated.truth_intensity(state or 0)
        truth = truth_dataset(simulated.truth_wavefront(state or 0), light, bench)
    write_results(out / _TRUTH, truth, bench=bench, inputs={"frame": "frame.tif"})
    return scintillation(light)


def _mean_photons(simulated: SimulatedBench, camera: SimulatedCamera) -> tuple[NDArray[np.float32], int | None]:
    """Mean photons per pixel of one exposure, and the state of the sample."""
    start_s = simulated.clock.now()
    simulated.clock.sleep(camera.exposure_s)
    exposed = simulated.expose(start_s, simulated.clock.now())
    return exposed.photons, exposed.state


def _frame(camera: SimulatedCamera) -> tuple[NDArray[Any], int | None]:
    """One frame in counts, and the state of the sample."""
    camera.start()
    frame = camera.read(2 * camera.exposure_s)
    state = camera.state_of_frame(frame.index)
    camera.stop()
    return frame.pixels, state
