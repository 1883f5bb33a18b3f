"""`svwfs simulate`: simulated frames and the true wavefronts as files."""

from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from app.commands import options, terminal

_CONDITIONS = {"dark": (False, False), "reference": (True, False), "frame": (True, True)}  # light on, sample in
_TRUTH = "truth.nc"


def simulate(
    *,
    bench: options.Bench,
    out: Annotated[Path, options.folder_option("Folder for dark.tif, reference.tif, frame.tif and truth.nc.")],
    setting: options.Set = None,
    noise_free: Annotated[bool, typer.Option("--noise-free", help="Write mean photons instead of counts.")] = False,
    overwrite: options.Overwrite = False,
) -> None:
    """Simulate dark, reference and frame, with the true wavefronts.

    Example: svwfs simulate --bench paper_simulation --out simulated
    """
    from app.acquisition.devices import simulated_bench
    from app.images import write_image
    from app.results.dataset import truth_dataset
    from app.results.result_file import write_results
    from simulated_devices.camera import SimulatedCamera
    from simulated_devices.clock import ManualClock
    from simulated_devices.sample import scintillation

    loaded = options.load(bench, setting)
    outputs = [out / name for name in (*(f"{name}.tif" for name in _CONDITIONS), _TRUTH)]
    options.check_files(*outputs, reads=options.files_of_bench(bench, loaded), overwrite=overwrite)
    with (
        terminal.progress_bar() as progress,
        closing(simulated_bench(loaded, partial(progress, "rendering"), ManualClock())) as simulated,
        SimulatedCamera(simulated) as camera,
    ):
        images: dict[str, Any] = {}  # Ctrl-C while they are rendered leaves no half set
        state: int | None = None
        for name, (light_on, sample_in) in _CONDITIONS.items():
            simulated.change(is_light_on=light_on, is_sample_in=sample_in)
            if noise_free:  # mean photons per pixel of one exposure
                start_s = simulated.clock.now()
                simulated.clock.sleep(camera.exposure_s)
                exposed = simulated.expose(start_s, simulated.clock.now())
                images[name], state = exposed.photons, exposed.state
            else:
                camera.start()
                frame = camera.read(2 * camera.exposure_s)
                images[name], state = frame.pixels, camera.state_of_frame(frame.index)
                camera.stop()
        light = simulated.renderer.truth_intensity(state or 0)
        truth = truth_dataset(simulated.renderer.truth_wavefront(state or 0), light, loaded)
        write_results(out / _TRUTH, truth, bench=loaded, inputs={"frame": "frame.tif"})
        for name, image in images.items():
            write_image(out / f"{name}.tif", image)
    typer.echo(f"dark.tif, reference.tif, frame.tif and truth.nc are in {out}")
    typer.echo(f"light at the lenslets: {100 * scintillation(light):.1f} % RMS from that without the sample")
