"""The tables of `svwfs paper`: table 1, table 2, and the sources of the supplement."""

import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from app.plotting import Figure

# isort: split
import numpy as np
import pandas as pd
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from app.acquisition.devices import simulated_bench
from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, seeded
from app.evaluation.paper import nonrigid_methods
from app.files import atomic_write
from app.measurement.calibration import Calibration
from app.progress import Progress, part
from app.run_facts import write_record
from drivers.interface import BadValue
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import nominal_lattice
from reconstruction.reconstructor import OwnMethods, OwnRegistration
from reconstruction.runtime.opencv import cv2
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.wavefront import rms, without_piston
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock

TableMask = Literal["square", "stars"]
Table = Literal["table1", "table2", "sources"]
_TITLES = {"table1": "Simulation", "table2": "Experiment", "sources": "Other sources"}

_CROP, _RESIZED = 469, 465  # px; the paper's frames end with 31 pixels per lenslet
_DARKS = 8  # frames that are averaged


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """Reference and frame of one mask, counts or photons above the dark, (row, column)."""

    reference: Image
    frame: Image


def noise_free_frames(bench: Bench, masks: tuple[str, ...]) -> tuple[dict[str, FramePair], Floats]:
    """Return mean photons of reference and frame for each mask, and the true wavefronts of the views."""
    rendered = NoiseFreeFrames(bench)
    with_sample = {mask: rendered.frame(mask) for mask in masks}
    frames = {mask: FramePair(rendered.reference(mask), frame.photons) for mask, frame in with_sample.items()}
    return frames, with_sample[masks[0]].truth


def exposed_frames(bench: Bench) -> tuple[dict[str, FramePair], Floats]:
    """Return noisy frames above the dark for each mask of `EXPOSURES_S`, and the true wavefronts."""
    frames: dict[str, FramePair] = {}
    simulated = simulated_bench(bench, lambda _: None, ManualClock())
    with closing(simulated), SimulatedCamera(simulated) as camera:
        for mask, exposure_s in EXPOSURES_S.items():
            try:
                camera.set_exposure(exposure_s)
            except BadValue as error:
                raise InputError(f"camera: the {mask} need another amplifier or readout_speed: {error}") from error
            simulated.change(mask=mask, is_light_on=False, is_sample_in=False)
            dark = np.mean([_photograph(camera) for _ in range(_DARKS)], axis=0)
            simulated.change(is_light_on=True)
            reference = _photograph(camera) - dark
            simulated.change(is_sample_in=True)
            frames[mask] = FramePair(reference.astype(np.float32), (_photograph(camera) - dark).astype(np.float32))
        return frames, simulated.renderer.truth_wavefront(0)


def _photograph(camera: SimulatedCamera) -> Image:
    camera.start()
    pixels = camera.read(2 * camera.exposure_s).pixels
    camera.stop()
    return pixels.astype(np.float32)


def resized(bench: Bench, frames: Mapping[str, FramePair]) -> tuple[Bench, dict[str, FramePair]]:
    """Crop 469 x 469 pixels and resize them to 465 x 465 bicubically, as in the paper; return the bench for them."""
    sensor = replace(bench.sensor, pixel_pitch_m=bench.sensor.lenslet_pitch_m / 31)
    lattice = nominal_lattice(sensor, _RESIZED, _RESIZED)
    return replace(bench, sensor=sensor, lattice=lattice), {
        mask: FramePair(_crop_and_resize(pair.reference), _crop_and_resize(pair.frame)) for mask, pair in frames.items()
    }


def _crop_and_resize(image: Image) -> Image:
    top, left = ((length - _CROP) // 2 for length in image.shape)
    middle = image[top : top + _CROP, left : left + _CROP]
    return np.asarray(cv2.resize(middle, (_RESIZED, _RESIZED), interpolation=cv2.INTER_CUBIC), np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class TableMethod:
    """One row of a table."""

    mask: TableMask = "square"
    registration: RegistrationSettings = RegistrationSettings()
    own: OwnRegistration | None = None  # in place of that of the settings
    reconstruction: ReconstructionSettings

    @property
    def is_peer(self) -> bool:
        """True if it needs the extra `svwfs[peers]`."""
        of_itk = (nonrigid_methods.Demons, nonrigid_methods.FreeForm)
        return self.registration.method == "itk_affine" or self.own in of_itk


ZONAL = ReconstructionSettings(method="zonal")
MODAL = ReconstructionSettings(method="modal", pupil_modes=45)  # the paper's
MODAL_MANY = ReconstructionSettings(method="modal", pupil_modes=91)
_CENTROIDS = RegistrationSettings(method="centroids")
_ITK = RegistrationSettings(method="itk_affine")
_SHIFT = RegistrationSettings(warp="translation")  # of least squares, as the paper finds by correlation
_AFFINE = RegistrationSettings(warp="affine", rotation=True)  # the paper's, with six parameters
_GRADIENT_AFFINE = RegistrationSettings(warp="affine")  # with five: subimages do not rotate
_QUADRATIC = RegistrationSettings(warp="quadratic")
_CUBIC = RegistrationSettings(warp="cubic")

Methods = Mapping[str, TableMethod]
METHODS: dict[str, TableMethod] = {
    "stars_zonal": TableMethod(mask="stars", registration=_CENTROIDS, reconstruction=ZONAL),
    "shift_zonal": TableMethod(registration=_SHIFT, reconstruction=ZONAL),
    "itk_affine_zonal": TableMethod(registration=_ITK, reconstruction=ZONAL),
    "itk_affine_modal": TableMethod(registration=_ITK, reconstruction=MODAL),
    "block_flow_zonal": TableMethod(own=nonrigid_methods.BlockFlow, reconstruction=ZONAL),
    "demons_zonal": TableMethod(own=nonrigid_methods.Demons, reconstruction=ZONAL),
    "ffd_zonal": TableMethod(own=nonrigid_methods.FreeForm, reconstruction=ZONAL),
    "affine_zonal": TableMethod(registration=_AFFINE, reconstruction=ZONAL),
    "affine_modal": TableMethod(registration=_AFFINE, reconstruction=MODAL),
    "affine_gradient_zonal": TableMethod(registration=_GRADIENT_AFFINE, reconstruction=ZONAL),
    "affine_gradient_modal": TableMethod(registration=_GRADIENT_AFFINE, reconstruction=MODAL),
    "quadratic_zonal": TableMethod(registration=_QUADRATIC, reconstruction=ZONAL),
    "quadratic_modal": TableMethod(registration=_QUADRATIC, reconstruction=MODAL_MANY),
    "cubic_zonal": TableMethod(registration=_CUBIC, reconstruction=ZONAL),
    "cubic_modal": TableMethod(registration=_CUBIC, reconstruction=MODAL_MANY),
    "automatic": TableMethod(registration=RegistrationSettings(), reconstruction=ReconstructionSettings()),
}

# Minimum, maximum and mean over the views in the paper's tables, rad.
PAPER: dict[Table, dict[str, tuple[float, float, float]]] = {
    "table1": {
        "stars_zonal": (0.108, 0.197, 0.147),
        "itk_affine_zonal": (0.275, 0.589, 0.421),
        "itk_affine_modal": (0.383, 0.465, 0.417),
        "shift_zonal": (0.511, 1.260, 0.830),
    },
    "table2": {
        "itk_affine_zonal": (0.558, 2.450, 1.378),
        "itk_affine_modal": (0.617, 2.449, 1.461),
        "shift_zonal": (1.850, 10.228, 5.984),
    },
}


class Outcome(NamedTuple):
    """What a method makes of a frame."""

    views: Floats  # rad, (view_row, view_column, lenslet_row, lenslet_column)
    lost: int  # lenslets
    seconds: float  # for the frame, without preparing the reference


def reconstructed(bench: Bench, frames: Mapping[str, FramePair], method: TableMethod) -> Outcome:
    """Reconstruct the frame of the method's mask."""
    pair, stars = frames[method.mask], bench.simulation.source
    registration = replace(
        method.registration,
        star_rows=stars.star_rows,
        star_columns=stars.star_columns,
        star_spacing_m=stars.star_spacing_m,
    )
    bench = replace(bench, registration=registration, reconstruction=method.reconstruction)
    lattice, dark = bench.design_lattice(*pair.reference.shape), np.zeros_like(pair.reference)
    given = Calibration.of_images(bench, pair.reference, dark=dark, lattice=lattice)
    reconstructor = replace(given, own=OwnMethods(method.own)).reconstructor()
    start_s = time.perf_counter()
    wavefront = reconstructor(pair.frame)
    seconds = time.perf_counter() - start_s
    return Outcome(wavefront.views, int(np.count_nonzero(~wavefront.displacement.valid)), seconds)


NUMBERS = ["min_rad", "max_rad", "mean_rad"]
LIGHTS = {"neglected": True, "real": False}  # ways of the light to the lenslets, and `Field.neglect_propagation`
_HEADINGS = {"neglected": "ours: min, max, mean", "real": "in real light"}
EXPOSURES_S: dict[TableMask, float] = {"stars": 3.8, "square": 0.15}  # the paper's
SOURCES = ("square", "circle", "ellipse", "octagon", "peaks")

Row = dict[str, Any]
"""One method on one screen: `method`, `light`, `views` and `truth`, rad, (view_row, view_column, lenslet_row,
lenslet_column), `NUMBERS`, `lost` and `seconds`; or `problem`, why there is no result."""


def compare(table: Table, bench: Bench, *, seeds: int, with_peers: bool, progress: Progress) -> pd.DataFrame:
    """Measure a table of the paper; return a row for each method, light and screen, see `Row`.

    Table 1 is its simulation: every method on noise-free frames, compared to the truth. Table 2 is its experiment:
    noisy frames with both exposures, compared to the stars; every method runs on windows at the true sub-pixel centres
    and (`_resized`) on frames that are cropped and resized as in the paper, and `against_truth` compares the stars with
    the true wavefronts. The sources are those of its supplement: the same screens, other shapes. Each is measured with
    propagation neglected, as the paper simulates it, and in real light.
    """
    if bench.sensor.arrangement != "square":
        raise InputError("the paper's tables are made for square lattices: leave out lattice.arrangement")
    methods = {name: each for name, each in METHODS.items() if with_peers or not each.is_peer}
    measure, rows = {"table1": _table1, "table2": _table2, "sources": _sources}[table], list[Row]()
    for index, (light, neglect) in enumerate(LIGHTS.items()):
        lit = replace(bench, field=replace(bench.field, neglect_propagation=neglect))
        for done, screen in enumerate(seeded(lit, range(seeds))):
            step = part(part(progress, index, len(LIGHTS)), done, seeds)
            rows += [{"problem": "", **row, "light": light} for row in measure(methods, screen, step)]
    data = pd.DataFrame(rows)
    if "views" not in data:
        raise InputError("; ".join(f"{method}: {problem}" for method, problem in problems(data).items()))
    for name in ("method", "light"):
        data[name] = pd.Categorical(data[name], categories=data[name].unique())
    return data.sort_values(["method", "light"], kind="stable", ignore_index=True)


def _table1(methods: Methods, bench: Bench, progress: Progress) -> Iterator[Row]:
    progress("rendering", 0.0)
    frames, truth = noise_free_frames(bench, ("square", "stars"))
    yield from _all_compared(bench, frames, truth, methods, progress)


def _table2(methods: Methods, bench: Bench, progress: Progress) -> Iterator[Row]:
    progress("rendering and exposing", 0.0)
    frames, truth = exposed_frames(bench)
    for half, (suffix, each, its_frames) in enumerate((("", bench, frames), ("_resized", *resized(bench, frames)))):
        try:  # what the experiment takes for the truth
            stars = reconstructed(each, its_frames, METHODS["stars_zonal"])
        except ReconstructionError as error:
            raise InputError(f"the stars cannot be measured on this bench: {error}") from error
        yield _compared(f"stars_zonal{suffix}_against_truth", bench, stars, truth)
        named = {f"{name}{suffix}": method for name, method in methods.items() if method.mask == "square"}
        yield from _all_compared(each, its_frames, stars.views, named, part(progress, half, 2))


def _sources(_: Methods, bench: Bench, progress: Progress) -> Iterator[Row]:
    progress("rendering", 0.0)
    frames, truth = noise_free_frames(bench, SOURCES)
    kinds = [f"{warp}_{solve}" for warp in ("affine", "affine_gradient", "quadratic") for solve in ("zonal", "modal")]
    for source in SOURCES:
        methods = {f"{source}_{kind}": METHODS[kind] for kind in kinds}
        yield from _all_compared(bench, {"square": frames[source]}, truth, methods, progress)


def _all_compared(
    bench: Bench, frames: Mapping[str, FramePair], truth: Floats, methods: Methods, progress: Progress
) -> Iterator[Row]:
    """Yield each method's result next to the truth, rad, (view_row, view_column, lenslet_row, lenslet_column)."""
    for done, (name, method) in enumerate(methods.items()):
        progress(name, done / len(methods))
        try:
            yield _compared(name, bench, reconstructed(bench, frames, method), truth)
        except ReconstructionError as error:
            yield {"method": name, "problem": str(error)}


def _compared(name: str, bench: Bench, made: Outcome, truth: Floats) -> Row:
    """Return a result next to the truth, rad, (view_row, view_column, lenslet_row, lenslet_column), if all is known."""
    x, y = bench.field.view_x_m, bench.field.view_y_m
    is_inside = bench.field.contains(x / bench.field.half_width_m, y[:, None] / bench.field.half_width_m)
    residual = rms(made.views - truth)
    if np.isnan(residual[is_inside]).any():
        return {"method": name, "problem": f"{made.lost} lenslets are lost: a view is unknown"}
    numbers = (float(of(residual)) for of in (np.nanmin, np.nanmax, np.nanmean))
    scalars = dict(zip(NUMBERS, numbers, strict=True)) | {"lost": float(made.lost), "seconds": made.seconds}
    return {"method": name, "views": made.views, "truth": truth, **scalars}


def problems(data: pd.DataFrame) -> dict[str, str]:
    """Return the last problem of each method that had one; real light is named."""
    refused = data[data["problem"] != ""]
    names = refused["method"].astype(str) + np.where(refused["light"] == "real", " in real light", "")
    return dict(zip(names, refused["problem"], strict=True))


def summary(data: pd.DataFrame) -> pd.DataFrame:
    """Minimum, maximum and mean over the views, averaged over the seeds, and the spread of the means."""
    seeds = data[data["problem"] == ""].groupby(["method", "light"], observed=True)
    means = seeds[[*NUMBERS, "lost", "seconds"]].mean().rename(columns={"lost": "lost_lenslets"})
    means.insert(len(NUMBERS), "spread_rad", seeds["mean_rad"].std().fillna(0.0))
    return means.assign(seeds=seeds.size()).reset_index()


def write_table(table: Table, data: pd.DataFrame, out: Path) -> None:
    """Write JSON and figure of a table into a folder, with the paper's numbers next to ours."""
    paper = {method: dict(zip(NUMBERS, numbers, strict=True)) for method, numbers in PAPER.get(table, {}).items()}
    ours: dict[str, dict[str, Row]] = {light: {} for light in LIGHTS}
    for row in summary(data).to_dict("records"):
        ours[row["light"]][row["method"]] = {str(name): value for name, value in row.items()}
    tree = {"paper": paper, "ours": ours["neglected"], "in_real_light": ours["real"], "problems": problems(data)}
    write_record(out / f"{table}.json", tree)
    with atomic_write(out / f"{table}.png") as temporary:
        figure(table, data).savefig(temporary, dpi=100)


def printed(table: Table, data: pd.DataFrame) -> tuple[str, list[str], list[list[str]], list[str]]:
    """Return title, headings, a line for each method, and notes."""
    lines: dict[str, list[str]] = {}
    lights = data["light"].cat.categories.tolist()
    for row in summary(data).to_dict("records"):
        method = row["method"]
        paper = " ".join(f"{value:6.3f}" for value in PAPER.get(table, {}).get(method, ()))
        cells = lines.setdefault(method, [method, paper, *("",) * 2 * len(lights)])
        ours = " ".join(f"{row[number]:6.3f}" for number in NUMBERS)
        spread = f" +- {row['spread_rad']:.3f}" if row["seeds"] > 1 else ""
        place = 2 + 2 * lights.index(row["light"])
        cells[place : place + 2] = ours + spread, f"{row['lost_lenslets']:.0f}"
    of_lights = [heading for light in lights for heading in (_HEADINGS[light], "lost")]
    notes = [f"{method}: {problem}" for method, problem in problems(data).items()]
    title = f"{_TITLES[table]}: residual RMS (rad) against the {_compared_to(table)}"
    return title, ["method", "paper: min, max, mean", *of_lights], [*lines.values()], notes


def figure(table: Table, data: pd.DataFrame) -> Figure:
    """Draw truth, reconstruction and residual of every method and light for its last seed."""
    shown = data[data["views"].notna()].drop_duplicates(["method", "light"], keep="last")
    means = summary(data)["mean_rad"]
    limit = max(float(np.nanmax(abs(truth))) for truth in shown["truth"])
    scale = Normalize(-limit, limit)
    drawn = Figure(figsize=(8.6, 2.4 * len(shown) + 0.6), layout="constrained")
    axes = drawn.subplots(len(shown), 3, squeeze=False)
    for row, mean_rad, of_row in zip(axes, means, shown.itertuples(), strict=True):
        name = of_row.method + ", real light" * (of_row.light == "real")
        residual = f"residual, mean RMS {mean_rad:.3f} rad"
        titled = {_compared_to(table): of_row.truth, name: of_row.views, residual: of_row.views - of_row.truth}
        for axis, (title, values) in zip(row, titled.items(), strict=True):
            framed = np.pad(without_piston(values), ((0, 0), (0, 0), (1, 1), (1, 1)), constant_values=np.nan)
            mosaic = np.block([list(each) for each in framed])  # views as they lie in the field, with gaps
            axis.imshow(mosaic, cmap="RdBu_r", norm=scale, interpolation="nearest")
            axis.set_title(title, fontsize=8)
            axis.set_axis_off()
    drawn.colorbar(ScalarMappable(scale, "RdBu_r"), ax=axes, label="wavefront (rad)", shrink=0.6)
    return drawn


def _compared_to(table: Table) -> str:
    return "stars" if table == "table2" else "truth"
