"""The settings of a batch, which all results in one store share."""

from dataclasses import dataclass, replace
from importlib.metadata import version

from app.bench.config import parse_bench
from app.measurement.calibration import Calibration
from app.recording.reprocess import Change
from app.results.replay import change_of


def _software() -> str:
    return f"svwfs {version('svwfs')}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """How each recording is reconstructed. Another version of the software may compute other bits."""

    bench: str = ""  # TOML text of another bench; empty: each recording's own
    settings: tuple[str, ...] = ()  # changes of the recorded benches
    rounds: int = 0  # of refinement, at most
    frames: str = ""  # of each recording, FIRST:END; empty: all
    software: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "software", self.software or _software())

    @property
    def is_of_this_software(self) -> bool:
        """True if this process runs the same version of svwfs."""
        return self.software == _software()

    @property
    def change(self) -> Change:
        """The change of a recorded calibration; it registers in one thread, as each worker has one core."""
        other = change_of(parse_bench(self.bench, "the bench") if self.bench else None, self.settings)

        def change(calibration: Calibration) -> Calibration:
            changed = calibration if other is None else other(calibration)
            registration = replace(changed.bench.registration, threads=1)
            return replace(changed, bench=replace(changed.bench, registration=registration))

        return change
