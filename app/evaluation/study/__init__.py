"""All sweeps and trials of `svwfs study`, by name."""

from collections.abc import Sequence
from pathlib import Path

from app.errors import InputError
from app.evaluation.studies import Study
from app.evaluation.study.bench import BENCH
from app.evaluation.study.deconvolution import DECONVOLUTION
from app.evaluation.study.layers import CORRECTOR, DISTANCES
from app.evaluation.study.masks import many_masks_study, mask_study
from app.evaluation.study.sweeps import SWEEPS
from app.evaluation.study.trials import EXPOSURE, calibration_trials


def chosen_studies(names: Sequence[str], frames: Path | None = None) -> list[Study]:
    """Return the studies with these names, each once; without names all sweeps.

    The names after `mask` or `masks` are those of masks, see `mask_study` and `many_masks_study`. `frames` is a folder
    of reference frames for the calibration, see `calibration_trials`.
    """
    of_masks = {"mask": mask_study, "masks": many_masks_study}
    place = next((index for index, name in enumerate(names) if name in of_masks), len(names))
    names, last = names[:place], names[place:]
    known: dict[str, Study] = {
        study.name: study
        for study in (*SWEEPS, calibration_trials(frames), EXPOSURE, DECONVOLUTION, CORRECTOR, DISTANCES, BENCH)
    }
    for name in names:
        if name not in known:
            raise InputError(f"no sweep is called {name}; there are {', '.join([*known, *of_masks])}")
    if frames is not None and "calibration" not in names:
        raise InputError("--frames is only for the calibration study: add the name calibration")
    chosen = [known[name] for name in dict.fromkeys(names)]
    if last:
        chosen.append(of_masks[last[0]](last[1:]))
    return chosen or [*SWEEPS]
