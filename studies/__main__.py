"""Command line of the studies: `python -m studies --help`."""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from app.bench.config import load_bench
from app.bench.presets import PAPER
from app.errors import InputError, RunError
from app.files import atomic_write, make_folder, write_whole
from reconstruction.errors import ReconstructionError
from studies.calibration import calibration
from studies.contestants import contestants
from studies.deconvolution import deconvolution
from studies.depth import depth
from studies.exposure import exposure
from studies.imperfect_bench import imperfect_bench
from studies.layers import corrector, distances
from studies.masks import mask, masks
from studies.noise import em_gain, photons
from studies.screens import ensembles, experiment, roughness, size
from studies.tables import Asked, Made
from studies.wrong_settings import dead, focal_length, lattice, source

Study = Callable[[Asked], Made]
STUDIES: dict[str, Study] = {
    study.__name__: study
    for study in (
        *(ensembles, roughness, size, experiment, photons, em_gain, source, lattice, focal_length, dead),
        *(imperfect_bench, mask, masks, calibration, exposure, distances, depth, corrector),
        *(deconvolution, contestants),
    )
}


def main(words: Sequence[str] | None = None) -> None:
    """Run one study and write NAME.csv and NAME.png; words are the arguments of the process if omitted."""
    about = "\n".join(f"  {name:15} {(study.__doc__ or '').splitlines()[0]}" for name, study in STUDIES.items())
    parser = argparse.ArgumentParser(
        "python -m studies", epilog=f"studies:\n{about}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=STUDIES, metavar="NAME", help="study, see below")
    parser.add_argument("masks", nargs="*", metavar="MASK", help="of mask and masks: names, checkerboard:5, pictures")
    parser.add_argument("--out", type=Path, default=Path("study"), help="folder of NAME.csv and NAME.png [study]")
    parser.add_argument("--bench", default=PAPER, help=f"bench file or preset [{PAPER}]")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting of the bench")
    parser.add_argument(
        "--seeds",
        type=int,
        default=3,
        choices=range(1, 1001),
        metavar="N",
        help="number of screens, from the bench's seed on [3]",
    )
    parser.add_argument("--frames", type=Path, help="of calibration: folder of bench.toml and *_reference.tif")
    given = parser.parse_args(words)
    try:
        bench = load_bench(given.bench, given.set)
        if bench.sensor.arrangement != "square":
            sys.exit("studies: made for square lattices: leave out lattice.arrangement")
        make_folder(given.out)
        table, figure = STUDIES[given.name](Asked(bench, range(given.seeds), given.masks, given.frames))
        write_whole(given.out / f"{given.name}.csv", table.to_csv(index=False))
        with atomic_write(given.out / f"{given.name}.png") as temporary:
            figure.savefig(temporary, dpi=100)
    except (InputError, RunError, ReconstructionError) as error:
        sys.exit(f"studies: {error}")
    if {"curve", "at"} <= {*table}:  # a line for each curve
        table = table.pivot_table("mean_rad", "curve", "at", sort=False).reset_index()
    sys.stdout.write(table.to_string(index=False, float_format="{:.4g}".format, na_rep="-") + "\n")


if __name__ == "__main__":
    main()
