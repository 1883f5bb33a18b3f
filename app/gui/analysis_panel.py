"""What the wavefronts mean for an image: one view's modulation transfer, and how far one wavefront serves."""

from __future__ import annotations

import math

from PyQt6.QtWidgets import QHBoxLayout, QVBoxLayout, QWidget

from app.gui.analysis import Analysis
from app.gui.plots import MtfPlot, StructurePlot
from app.gui.quantities import number, place
from app.gui.widgets import ElidedLabel
from reconstruction.quality.isoplanatism import Isoplanatism


class AnalysisPanel(QWidget):
    """Two plots, and one sentence."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.mtf = MtfPlot()
        self.structure = StructurePlot()
        self.sentence = ElidedLabel()
        plots = QHBoxLayout()
        plots.setSpacing(16)
        plots.addWidget(self.mtf, 1)
        plots.addWidget(self.structure, 1)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(plots, 1)
        layout.addWidget(self.sentence)

    def show_analysis(self, analysis: Analysis) -> None:
        """Show what was found out about one view and about the field."""
        question = analysis.question
        if question.view is None:
            return
        row, column = question.view
        field = question.wavefront.field
        _, where, _ = place(float(field.view_x_m[column]), float(field.view_y_m[row]))
        self.mtf.show_transfer(analysis.transfer, where)
        self.structure.show_structure(analysis.isoplanatism)
        if analysis.isoplanatism is not None:
            sentence = verdict(analysis.isoplanatism)
            self.sentence.setText(sentence)
            self.sentence.setToolTip(f"{sentence}.\n{_explanation(analysis.isoplanatism)}")

    def show_nothing(self) -> None:
        """Show that there is no wavefront now."""
        self.mtf.show_transfer(None, "")
        self.structure.show_structure(None)
        self.sentence.setText("")


def verdict(found: Isoplanatism) -> str:
    """What one wavefront for the whole field would miss, in one sentence."""
    if math.isnan(found.error_rad):
        return "No lenslet is known all over the field"
    return f"One wavefront for all the field: off by {number(found.error_rad)} rad RMS; {_patch(found)}"


def _patch(found: Isoplanatism) -> str:
    patch_m = found.curve.patch_m
    return f"patch {patch_m * 1e3:.2f} mm" if math.isfinite(patch_m) else "patch wider than the field"


def _explanation(found: Isoplanatism) -> str:
    patch_m = found.curve_without_tilt.patch_m
    patch = f"{patch_m * 1e3:.2f} mm" if math.isfinite(patch_m) else "wider than the field"
    return (
        "That one wavefront is the mean over the field. The isoplanatic patch ends where two wavefronts differ by\n"
        "1 rad RMS (mean square 1 rad\N{SUPERSCRIPT TWO}).\n"
        f"Without tip and tilt, which displace the image and do not blur it: {number(found.error_without_tilt_rad)} rad"
        f" RMS; patch {patch}."
    )
