"""`svwfs simulate`: simulated frames and the true wavefronts as files."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.commands import options, terminal
from app.files import check_outputs
from app.progress import Progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from app.bench.config import Bench
    from simulated_devices.bench import SimulatedBench
    from simulated_devices.camera import SimulatedCamera

_CONDITIONS = {"dark": (False, False), "reference": (True, False), "frame": (True, True)}  # light on, sample in
_TRUTH = "truth.nc"


def simulate(
    *,
    bench: options.Bench,
    out: Annotated[
        Path, typer.Option(metavar=options.FOLDER, help="Folder for dark.tif, reference.tif, frame.tif and truth.nc.")
    ],
    setting: options.Set = None,
    noise_free: Annotated[
        bool, typer.Option("--noise-free", help="Write mean photons instead of the camera's counts.")
    ] = False,
    overwrite: options.Overwrite = False,
) -> None:
    """Simulate dark, reference and frame, with the true wavefronts.

    Example: svwfs simulate --bench paper_simulation --out simulated
    """
    loaded = options.load(bench, setting)
    check_outputs(
        [out / name for name in (*(f"{name}.tif" for name in _CONDITIONS), _TRUTH)],
        inputs=options.files_of_bench(bench, loaded),
        overwrite=overwrite,
    )
    with terminal.progress_bar() as progress:
        scintillation = _render(loaded, out, noise_free=noise_free, progress=progress)
    typer.echo(f"dark.tif, reference.tif, frame.tif and truth.nc are in {out}")
    typer.echo(f"light at the lenslets: {100 * scintillation:.1f} % RMS from that without the sample")


def _render(bench: Bench, out: Path, *, noise_free: bool, progress: Progress) -> float:
    """Write the files, and return the scintillation.

    That is the RMS of the light at the lenslets about that without sample, relative to it. The images are camera counts
    or, with `noise_free`, mean photons per pixel as float32.
    """
    from app.acquisition.devices import simulated_bench
    from app.images import write_image
    from app.results.dataset import truth_dataset
    from app.results.result_file import write_results
    from simulated_devices.camera import SimulatedCamera
    from simulated_devices.clock import ManualClock
    from simulated_devices.sample import scintillation

    opening = simulated_bench(bench, lambda fraction: progress("rendering", fraction), ManualClock())
    with closing(opening) as simulated, SimulatedCamera(simulated) as camera:
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
