"""What stands between the calibration's buttons and the acquisition: a lattice is proposed before it is used."""

from __future__ import annotations

from functools import partial

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.gui import commands
from app.gui.answers import Answers
from app.gui.camera_panel import CameraPanel
from app.gui.message_strip import MessageStrip
from app.measurement.routines.auto_exposure import AutoExposure
from app.measurement.routines.background import BackgroundCheck
from reconstruction.lattice.search import Survey


class CalibrationControl:
    """Has routines executed, and says what they have found."""

    def __init__(self, camera_panel: CameraPanel, messages: MessageStrip, answers: Answers) -> None:
        self._camera_panel, self._messages, self._answers = camera_panel, messages, answers
        self._survey: Survey | None = None  # that is proposed

    def survey(self, acquisition: Acquisition) -> None:
        """Find the lattice in the reference, and propose it."""
        self._answers.expect(acquisition.submit(Instrument.survey_lattice), self._propose)

    def answer(self, acquisition: Acquisition, *, is_wanted: bool) -> None:
        """Use the lattice that is proposed, or forget it."""
        survey = self._survey
        self.forget()
        if survey is not None and is_wanted:
            command = partial(commands.use_lattice, lattice=survey.lattice)
            self._answers.expect(
                acquisition.submit(command), lambda _: self._messages.tell("the lattice is in use; Ctrl+S saves it")
            )

    def forget(self) -> None:
        """Propose nothing any more."""
        self._survey = None
        self._camera_panel.propose(None)

    def auto_expose(self, acquisition: Acquisition) -> None:
        """Find and use the exposure that fills most of the camera's range."""
        self._answers.expect(acquisition.auto_expose(), self._tell_exposure)

    def check_background(self, acquisition: Acquisition) -> None:
        """Say whether the dark is still good."""
        self._answers.expect(acquisition.check_background(), self._tell_background)

    def _propose(self, survey: Survey) -> None:
        self._survey = survey
        self._camera_panel.propose(survey)
        lattice, lenslets = survey.lattice, survey.illuminated
        self._messages.ask(
            f"found: pitch {lattice.pitch_px:.3f} px, turned {lattice.rotation_rad * 1e3:+z.2f} mrad,"
            f" centre {lattice.center_x_px:.2f}, {lattice.center_y_px:.2f} px;"
            f" {lenslets.sum()} of {lenslets.size} lit, {survey.residual_px:.3f} px RMS beside it"
        )

    def _tell_exposure(self, found: AutoExposure) -> None:
        self._messages.tell(
            f"exposure {found.exposure_s * 1e3:.4g} ms, light {found.current_a * 1e3:.4g} mA:"
            f" {100 * found.fill:.0f} % of full scale, after {found.frames} frames"
        )

    def _tell_background(self, check: BackgroundCheck) -> None:
        (self._messages.tell if check.is_good else self._messages.warn)(check.verdict)
