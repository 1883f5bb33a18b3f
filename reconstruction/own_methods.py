"""Methods from outside the source tree: a registration, a basis of pupil modes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

from reconstruction.displacement import RegistrationMethod
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.pupil_modes import PupilModes
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import ReconstructionSettings, RegistrationSettings

OwnRegistration: TypeAlias = Callable[[ReferenceSubimages, Field], RegistrationMethod]
OwnBasis: TypeAlias = Callable[[Sensor, int | None], PupilModes]


@dataclass(frozen=True, slots=True)
class OwnMethods:
    """What replaces the methods of the settings; None: nothing."""

    registration: OwnRegistration | None = None  # prepares itself for a reference and a field
    basis: OwnBasis | None = None  # makes that many modes, piston first; all that the lattice carries if None

    def named(
        self, registration: RegistrationSettings, reconstruction: ReconstructionSettings
    ) -> tuple[RegistrationSettings, ReconstructionSettings]:
        """Settings with the names of own methods: who reads them elsewhere is told that they are unknown."""
        if self.registration is not None:
            registration = replace(registration, method=_name(self.registration))  # type: ignore[arg-type] # a name of none of ours
        if self.basis is not None:
            reconstruction = replace(reconstruction, basis=_name(self.basis))  # type: ignore[arg-type] # the same
        return registration, reconstruction


NO_OWN = OwnMethods()


def _name(method: object) -> str:
    return f"own {getattr(method, '__name__', type(method).__name__)}"
