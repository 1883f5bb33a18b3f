"""Why a lenslet is lost, in words."""

from __future__ import annotations

from reconstruction.displacement import Outcome

REASONS = {
    Outcome.CONVERGED: "",
    Outcome.DARK: "no light",
    Outcome.SATURATED: "saturated",
    Outcome.DIVERGED: "no match with the reference",
    Outcome.LEFT_CELL: "displaced into a neighbour's cell",
    Outcome.OFF_CAMERA: "not wholly on the camera",
}
