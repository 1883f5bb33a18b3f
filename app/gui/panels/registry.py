"""All panels of the window: a new one needs its file and its line here."""

from typing import NamedTuple, get_type_hints

from app.gui.panels.camera import CameraPanel
from app.gui.panels.coefficients import CoefficientsPanel
from app.gui.panels.controls import ControlsPanel
from app.gui.panels.corrector import CorrectorPanel
from app.gui.panels.histogram import HistogramPanel
from app.gui.panels.history import HistoryPanel
from app.gui.panels.layers import LayersPanel
from app.gui.panels.lenslet import LensletPanel
from app.gui.panels.panel import DisplayState
from app.gui.panels.quality import QualityPanel
from app.gui.panels.wavefronts import WavefrontPanel


class Panels(NamedTuple):
    """The panels in the order of tabs and menus."""

    camera: CameraPanel
    wavefronts: WavefrontPanel
    quality: QualityPanel
    coefficients: CoefficientsPanel
    history: HistoryPanel
    histogram: HistogramPanel
    lenslet: LensletPanel
    layers: LayersPanel
    corrector: CorrectorPanel
    controls: ControlsPanel


def make_panels(shown: DisplayState) -> Panels:
    """Make all panels, and connect those that follow each other."""
    made = Panels(*(kind(shown) for kind in get_type_hints(Panels).values()))
    made.camera.counts_for = made.controls, made.histogram
    made.camera.lenslet_clicked.connect(made.lenslet.inspect)
    made.histogram.levels_chosen.connect(made.camera.use_levels)
    made.coefficients.pinned.connect(made.history.pin)
    return made
