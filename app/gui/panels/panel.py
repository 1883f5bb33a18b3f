"""Base class of the panels, and the state that they share."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from PyQt6.QtCore import QObject, pyqtSignal
from PyQt6.QtGui import QAction, QShowEvent
from PyQt6.QtWidgets import QAbstractButton, QMenu, QTableWidget, QWidget

from app.acquisition.instrument import Status
from app.gui.widgets import theme
from app.gui.widgets.plot import Plot
from app.gui.widgets.texts import ElidedLabel
from app.gui.widgets.view_grid import ViewGrid
from app.measurement.measurement import Measurement
from app.results.frame_statistics import FrameStatistics
from app.results.shown_wavefront import Unit
from reconstruction.pupil import Pupil
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront

Act = Callable[[], object] | QAbstractButton | QAction | QMenu  # a button lends its entry tick and greying
Entries = tuple[tuple[str, str, Act] | None, ...]  # text, key and action, or a separator
MoreEntries = tuple[QAction | tuple[str, Callable[[], object]], ...]  # of a panel's own menu
Check = Callable[[], None]  # raises when the window closes
SLOWER_S = 0.36  # interval of what takes some milliseconds: three times a second


class DataFreshness(NamedTuple):
    """Differences of a shown frame from a live one; empty if there are none."""

    badge: str = ""
    reason: str = ""
    is_grey: bool = False  # whether the bench may differ from what is shown by now


class Verdict(NamedTuple):
    """Verdict on the newest frame by the limits of the history; empty without limits."""

    text: str = ""  # pass, fail, or a dash
    reason: str = ""  # a line for each limited quantity


class DisplayState(QObject):
    """State shared by the panels: newest measurement, chosen view and unit, and whether they are live."""

    view_chosen = pyqtSignal()
    pupil_drawn = pyqtSignal(object)  # over which wavefronts are to be shown
    exclusion_requested = pyqtSignal(object, object)  # of lenslets (row, column): whether, or None to change each

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self.status: Status | None = None
        self.reconstruction: ReconstructionSettings | None = None  # settings of the wavefronts
        self.wanted: Mapping[Any, Any] = {}  # settings that are not in force yet, by what changes them
        self.is_settled = True  # whether all commands are finished
        self.measurement: Measurement | None = None
        self.statistics: FrameStatistics | None = None  # of a recent frame
        self.levels: tuple[float, float] | None = None  # counts that are black and white in the camera picture
        self.wavefront: Wavefront | None = None  # of the measurement, with the display options applied to its views
        self.unit, self.wavelength_m = Unit.RAD, float("nan")
        self.options = ""  # of the display, in words
        self.pupil: Pupil | None = None  # of the shown wavefront
        self.replayed: tuple[str, float] | None = None  # name and time, s, of the shown frame of a recording
        self.recording: Path | None = None  # folder of the recording that is replayed
        self.sigma_rad: float | None = None  # mean error of the shown wavefronts, RMS
        self.pinned_rad: float | None = None  # present value of the pinned coefficient
        self.data_freshness, self.problem = DataFreshness(), ""  # the problem: why there may be no wavefront
        self.verdict = Verdict()
        self._view: tuple[int, int] | None = None  # as chosen; None: the middle one

    def proposed(self, name: str) -> str:
        """Return the name of a file to propose: next to the replayed recording, and with its name, if there is one."""
        if self.recording is None:
            return name
        frame = "" if self.replayed is None else f" {self.replayed[0]}"
        return str(self.recording.with_name(f"{self.recording.name}{frame} {name}"))

    @property
    def per_rad(self) -> float:
        return self.unit.per_rad(self.wavelength_m)

    @property
    def view(self) -> tuple[int, int] | None:
        """The chosen view (row, column) if it exists, else the middle one; None without a wavefront."""
        if self.wavefront is None:
            return None
        rows, columns = self.wavefront.views.shape[:2]
        if self._view is not None and self._view[0] < rows and self._view[1] < columns:
            return self._view
        return rows // 2, columns // 2

    def choose_view(self, row: int, column: int) -> None:
        self._view = (row, column)
        self.view_chosen.emit()


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """Something to compute in the background."""

    of: object  # the measurement or wavefront
    choice: Hashable  # all else that the result depends on
    compute: Callable[[Check], Any]
    interval_s: float = 0.2  # at least, between two of a running measurement


class Panel(QWidget):
    """A dockable panel, which overrides what it needs of these methods; `app.gui.shell.docks` lists all."""

    title: ClassVar[str]
    is_tab: ClassVar[bool] = True  # in the default layout

    warned = pyqtSignal(str)  # why something was not done
    informed = pyqtSignal(str)  # what was done
    front_requested = pyqtSignal()

    def __init__(self, shown: DisplayState) -> None:
        super().__init__()
        self.shown = shown
        self.header: QWidget | None = None  # in place of the title

    @property
    def is_needed(self) -> bool:
        """True if it is seen, or what it computes is used elsewhere; else it computes nothing."""
        return self.isVisible()

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802 - Qt's name
        super().showEvent(event)
        self.catch_up()

    def catch_up(self) -> None:
        """Show what has changed while the panel was hidden."""
        self.show_numbers()

    def menu_entries(self) -> Mapping[str, Entries]:
        """Return entries by the title of their menu."""
        return {}

    def more_entries(self) -> MoreEntries:
        """Return the first entries of the panel's own menu."""
        return ()

    def show_status(self, status: Status) -> None:
        """Show a changed state of the instrument."""

    def show_measurement(self, measurement: Measurement) -> None:
        """Show the newest frame and its wavefront, up to 25 times a second."""

    def show_numbers(self) -> None:
        """Show what changes too fast to be read otherwise, and whether it is live, five times a second."""

    def show_stale(self, *, is_stale: bool) -> None:
        """Show maps, plots and numbers without colour while the bench may differ from what is shown."""
        for plot in self.findChildren(Plot):
            plot.show_stale(is_stale=is_stale)
        for grid in self.findChildren(ViewGrid):
            grid.show_stale(is_stale=is_stale)
        in_header = () if self.header is None else self.header.findChildren(ElidedLabel)
        for text in (*self.findChildren((ElidedLabel, QTableWidget)), *in_header):
            theme.restyle(text, "stale", is_stale)

    def table(self) -> str:
        """Return the numbers of all visible maps and plots as tab-separated lines."""
        maps = (grid.table() for grid in self.findChildren(ViewGrid) if grid.isVisible())
        return "\n\n".join(
            filter(None, (*maps, *(plot.table() for plot in self.findChildren(Plot) if plot.isVisible())))
        )

    def show_nothing(self) -> None:
        """Clear what belongs to a wavefront: there is none."""

    def forget_bench(self) -> None:
        """Forget what belongs to a bench that was closed."""

    def request(self) -> Request | None:
        """Return what to compute, None if nothing; called while the panel is needed."""
        return None

    def show_result(self, result: Any, /) -> None:
        """Show what was computed, unless another choice was made meanwhile."""
