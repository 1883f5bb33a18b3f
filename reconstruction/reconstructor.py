"""From a camera frame to the wavefront: everything independent of the frame is prepared once."""

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from reconstruction.arrays import Counts, Floats, Image
from reconstruction.displacement import (
    LINEAR_TERMS,
    SYSTEMATIC_PX,
    Displacement,
    LensletStatus,
    LensletStatuses,
    RegistrationMethod,
)
from reconstruction.errors import ReconstructionError, TooManyModes
from reconstruction.frame.bad_pixels import find_bad_pixels
from reconstruction.frame.pixels import TOO_BRIGHT, UNKNOWN_CAMERA, DarkSubtractor, KnownCamera
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.layers.layer_search import search_layers, systematic_misfit
from reconstruction.layers.layer_solver import FrameEquations, LayerModes, LayerSolver
from reconstruction.layers.layered_wavefront import FREE, AssumedSample, LayeredWavefronts, most_probable
from reconstruction.modes.layered_modes import layered_wavefronts
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.registration import chosen, prepare_registration
from reconstruction.registration.response import WarpRegistration, fitting_model, linear_response
from reconstruction.registration.subimages import LensletModel, ReferenceSubimages
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import PupilBasis, ReconstructionSettings, RegistrationSettings, Warp, obstacle_to_layers
from reconstruction.solve.expected_errors import MeanGradients, Response, Sensitivity, relative_weights
from reconstruction.solve.modal import ModalSolution, ModalSolver
from reconstruction.solve.zonal import ZonalSolution
from reconstruction.wavefront import Solution, Wavefront

OwnRegistration: TypeAlias = Callable[[ReferenceSubimages, Field], RegistrationMethod]
OwnBasis: TypeAlias = Callable[[Sensor, int | None], PupilModes]


@dataclass(frozen=True, slots=True)
class OwnMethods:
    """Methods of the user in place of those of the settings; None for those of the settings."""

    registration: OwnRegistration | None = None  # prepares itself for a reference and a field
    basis: OwnBasis | None = None  # makes that many modes, piston first; all that the lattice carries if None

    def named(
        self, registration: RegistrationSettings, reconstruction: ReconstructionSettings
    ) -> tuple[RegistrationSettings, ReconstructionSettings]:
        """Settings with the names of own methods, which other readers report as unknown."""

        def name(method: object) -> Any:
            return f"own {getattr(method, '__name__', type(method).__name__)}"

        if self.registration is not None:
            registration = replace(registration, method=name(self.registration))
        if self.basis is not None:
            reconstruction = replace(reconstruction, basis=name(self.basis))
        return registration, reconstruction


NO_OWN = OwnMethods()

_DARK_CONTRAST = 0.2  # of the reference's; a frame with less in which nothing matches has no light
_READ_NOISE_ALONE = 0.7, 1.5  # times the read noise: a frame that scatters so shows nothing else; an average may
_SPARSE = 4  # every fourth row and column is sampled
_CERTAIN = 5.0  # standard errors, which chance does not reach in a million frames
_MORE = 1.5  # contradiction of a sample by other frames over that by the one in which it was found
# RMS quadratic brightness over the field, beyond noise: clear samples of any depth have 0.0025 to 0.0033, one with 8 %
# RMS of absorption 0.028.
_ABSORBS, _STILL_ABSORBS = 0.006, 0.005
_NO_MATCH = "no lenslet of the frame could be matched with the reference"
NOISE_MODES = 45  # pupil modes for which noise is predicted; a smooth wavefront needs about as many
# Systematic error, rad: mean over the ensembles of evidence/accuracy.md (square, propagation neglected, 4.2 rad).
_SYSTEMATIC_RAD: dict[Warp, float] = {"affine": 0.24, "quadratic": 0.036, "cubic": 0.009, "quartic": 0.007}
_CHOSEN_WARPS = list(_SYSTEMATIC_RAD)


def _called(what: str, kind: type | None, function: Any, *arguments: Any, **more: Any) -> Any:
    """Call an own method, which is to return a `kind`, or with None a callable; else `ReconstructionError`."""
    as_told = "as in svwfs docs extending"
    if not callable(function):
        raise ReconstructionError(f"{what} must be a callable, {as_told}, not {function!r:.60}")
    try:
        inspect.signature(function).bind(*arguments, **more)
    except ValueError:  # one of another language
        pass
    except TypeError as error:
        raise ReconstructionError(f"{what} must take other arguments, {as_told}: {error}") from error
    made = function(*arguments, **more)
    if not (callable(made) if kind is None else isinstance(made, kind)):
        needed = "a callable that registers frames" if kind is None else f"a {kind.__name__}"
        raise ReconstructionError(f"{what} must return {needed}, {as_told}, not {made!r:.60}")
    return made


def _require_shape(what: str, found: tuple[int, ...], sensor: Sensor) -> None:
    """Raise `ReconstructionError` unless something has a value for each lenslet."""
    if found != sensor.lenslets:
        raise ReconstructionError(f"{what} must be of {sensor.lenslets} lenslets (rows, columns), not {found}")


class _Registration(NamedTuple):
    """A registration method prepared for the reference."""

    settings: RegistrationSettings
    method: RegistrationMethod
    at_rest: Displacement  # of the reference from itself: the certainty of each lenslet and field mode
    warps: WarpRegistration | None  # the method, if it fits warps and has a response

    @property
    def parameters(self) -> Floats:
        """Displacement (x modes, y modes) of each parameter that the method finds, (K, 2Q)."""
        return np.eye(2 * self.at_rest.modes.count) if self.warps is None else self.warps.parameters

    @property
    def hidden(self) -> int:
        """Number of displacements that the mask does not show lenslet by lenslet."""
        return 0 if self.warps is None else self.warps.hidden


class Reconstructor:
    """Turns frames into wavefronts. Immutable: another reference or setting needs another one.

    Parameters
    ----------
    reference : (row, column)
        Counts of the frame without the sample.
    sensor, lattice, field, registration, reconstruction
        Geometry and settings of the bench. Without `registration.warp`, the warp with the least expected error.
    camera : KnownCamera
        Dark, saturation, nonlinearity and noise. The noise weights pixels and lenslets and gives absolute error bars.
    own : OwnMethods
        Methods that replace those of the settings.
    lenslet_model : callable, optional
        Returns a model of one lenslet for the reference's subimages. With it, the registration knows how a brightness
        that varies over the field looks, and the modal reconstruction uses its response in place of mean gradients.
    absorbs : bool
        Prepare for a sample that absorbs; `absorbing` does so when a frame shows one.

    Raises
    ------
    ReconstructionError
        If the images do not match or are saturated, or the lenslets cannot distinguish the pupil modes.
    """

    def __init__(  # noqa: PLR0913 - all of a measurement but the frame; all but the settings have defaults
        self,
        reference: Counts,
        *,
        sensor: Sensor,
        lattice: Lattice,
        field: Field,
        registration: RegistrationSettings,
        reconstruction: ReconstructionSettings,
        camera: KnownCamera = UNKNOWN_CAMERA,
        own: OwnMethods = NO_OWN,
        lenslet_model: Callable[[ReferenceSubimages], LensletModel] | None = None,
        absorbs: bool = False,
    ) -> None:
        self._absorbs = absorbs
        self._again = partial(
            Reconstructor,
            reference,
            sensor=sensor,
            lattice=lattice,
            field=field,
            reconstruction=reconstruction,
            camera=camera,
            own=own,
            lenslet_model=lenslet_model,
        )
        self.frame_shape = reference.shape[0], reference.shape[-1]  # `DarkSubtractor` checks that there are no more
        self._dark_subtractor = DarkSubtractor(self.frame_shape, camera)
        self.sensor, self.lattice, self.field, self.camera = sensor, lattice, field, camera
        self.noise = camera.noise.of_frame
        self._own = own
        registration, self.reconstruction = own.named(registration, reconstruction)
        light, _ = self._dark_subtractor(reference, "reference")
        if not np.mean(light) > 0:
            raise ReconstructionError(
                "the reference shows no light above the dark: was the light on for the dark, or off for the reference?",
                image="reference",
            )
        self._cut = partial(
            ReferenceSubimages,
            sensor=sensor,
            lattice=lattice,
            field=field,
            noise=camera.noise,
            bad=find_bad_pixels(reference, camera.dark, blur_px=sensor.blur_px),
            excluded=registration.excluded,
        )
        self.subimages, self._lenslet_model = self._cut(light), lenslet_model
        self._dark_contrast = _DARK_CONTRAST * float(self.subimages.light.std())
        read_noise = 0.0 if self.noise is None else self.noise.read_noise_counts
        self._no_light = tuple(min(each * read_noise, self._dark_contrast) for each in _READ_NOISE_ALONE)
        with one_blas_thread():  # so that results repeat
            self._prepare_estimators(light, registration)

    def _prepare_estimators(self, light: Image, registration: RegistrationSettings) -> None:
        """Prepare registration and solve."""
        reconstruction = self.reconstruction
        registration, self.method_reason = chosen(registration, self.subimages)
        if reconstruction.sample == "layers" and (obstacle := obstacle_to_layers(reconstruction, registration)):
            raise ReconstructionError(f'reconstruction.sample = "layers" is impossible with {obstacle}: change either')
        self._prepared = self._choose(light, registration)
        self.registration, at_rest = self._prepared.settings, self._prepared.at_rest
        self._sensitivity, self.response_problem = self._respond()
        self._expected = _variance(at_rest)  # (L,), px^2; NaN where unknown
        usual = np.nanmedian(self._expected) if np.isfinite(self._expected).any() else 1.0
        self._certainty = np.where(self.noise is None, 1.0, usual / self._expected).reshape(at_rest.valid.shape)
        self._modal = None
        if reconstruction.method == "modal":
            self._modal = self._solver(reconstruction.basis, reconstruction.pupil_modes)
        if at_rest.valid.any():
            self._solve(at_rest, FREE)  # fails early if the modes cannot be distinguished, and warms the caches

    def __call__(self, frame: Counts) -> Wavefront:
        """Measure the wavefront of a frame: `register`, find the `sample`, then `solve`."""
        with one_blas_thread():
            displacement = self.register(frame)
            return self.solve(displacement, sample=self.find_sample(displacement))

    @property
    def _may_absorb(self) -> bool:
        """True if more of the brightness can be taken out: its shape and the noise are known."""
        return self.brightness_terms > 1 and self.noise is not None and self._model[0] is not None

    @cached_property
    def absorbing(self) -> "Reconstructor":
        """The same for samples that absorb: more of a brightness over the field counts as no displacement."""
        if self._absorbs or not self._may_absorb:
            return self
        return self._again(registration=self.registration, absorbs=True)

    def _of(self, displacement: Displacement) -> "Reconstructor":
        """The one by which a frame was registered."""
        return self.absorbing if displacement.absorbs else self

    def shows_absorption(self, displacement: Displacement) -> bool:
        """True if the brightness of the subimages varies more over the field than that of a clear sample.

        A linear brightness is no displacement anyway; the quadratic part tells.
        """
        found = displacement.transmission if self._may_absorb else None
        if found is None:
            return False
        terms = found.coefficients[..., LINEAR_TERMS:]
        variance = np.einsum("...ii->...i", found.covariance)[..., LINEAR_TERMS:]
        known = np.isfinite(terms) & np.isfinite(variance)
        if not known.any():
            return False
        of_noise = float(np.mean(variance[known]))
        by_chance = _CERTAIN * math.sqrt(2 / np.count_nonzero(known)) * of_noise
        least = _STILL_ABSORBS if displacement.absorbs else _ABSORBS
        return float(np.mean(terms[known] ** 2)) - of_noise > least**2 + by_chance

    def register(
        self, frame: Counts, *, start: Displacement | None = None, absorbs: bool | None = None
    ) -> Displacement:
        """Measure the displacement of each subimage of a frame (row, column), counts, from the reference.

        `start`, of an earlier frame, saves time and changes the result by far less than its error. The frame shows
        whether the sample `absorbs`, unless that is given.
        `ReconstructionError` if fewer than two lenslets match the reference, or the frame has the wrong size or is
        saturated.
        """
        if absorbs and self.absorbing is not self:
            return self.absorbing.register(frame, start=start)
        light, saturated = self._dark_subtractor(frame, "frame")
        least, most = self._no_light
        if least < light[::_SPARSE, ::_SPARSE].std(dtype=np.float64) < most:  # each lenslet would take longest
            raise ReconstructionError(f"{_NO_MATCH}: is the light on?", image="frame")
        displacement = self._prepared.method(light, saturated=saturated, start=start)
        if np.count_nonzero(displacement.valid) < 2:
            is_dark = light.std(dtype=np.float64) < self._dark_contrast
            why = "is the light on?" if is_dark else _why_lost(displacement.outcome)
            raise ReconstructionError(f"{_NO_MATCH}: {why}", image="frame")
        if absorbs is None and not self._absorbs and self.shows_absorption(displacement):
            return self.absorbing.register(frame, start=start)  # as a replay does, which knows that it absorbs
        return displacement

    def find_sample(self, displacement: Displacement) -> AssumedSample:
        """Find the layers of the sample, if they may be assumed and explain the displacements.

        It takes some tenths of a second, or some seconds if one layer does not suffice. Raises `ReconstructionError` if
        the settings demand layers and none can be found.
        """
        if not self.may_be_layered:
            return FREE
        try:
            with one_blas_thread():
                search = search_layers(self.layers(displacement), None)
        except ReconstructionError as error:  # too few lenslets, or nothing moves
            if self.reconstruction.sample == "layers":
                raise ReconstructionError(f'{error} (reconstruction.sample = "layers")', image="frame") from error
            return FREE
        may_be_free = self.reconstruction.sample == "automatic"
        found = most_probable(search, may_be_free=may_be_free, is_blind=self.hidden > 0)
        # The search is right about its frame: others of the sample contradict it hardly more.
        return replace(found, allowed=max(1.0, _MORE * self.contradiction(self.solve(displacement, sample=found))))

    @property
    def may_be_layered(self) -> bool:
        """True if layers may be assumed of displacements that change over the field."""
        return self._assumes_layers(self.registration)

    def _assumes_layers(self, registration: RegistrationSettings) -> bool:
        return self.reconstruction.sample != "free" and not obstacle_to_layers(self.reconstruction, registration)

    def solve(
        self, displacement: Displacement, *, bias: Floats | None = None, sample: AssumedSample = FREE
    ) -> Wavefront:
        """Reconstruct the wavefront from displacements.

        `bias` (lenslet_row, lenslet_column, field_mode, xy), px, a known systematic error, is subtracted first.
        """
        if (made := self._of(displacement)) is not self:
            return made.solve(displacement, bias=bias, sample=sample)
        try:
            if bias is None:
                return self._solve(displacement, sample)
            return self._solve(displacement.minus(bias), sample, is_corrected=True)
        except ReconstructionError as error:
            if np.all(displacement.valid):
                raise
            raise ReconstructionError(f"{error}; {_why_lost(displacement.outcome)}", image="frame") from error

    def _solve(self, displacement: Displacement, sample: AssumedSample, *, is_corrected: bool = False) -> Wavefront:
        weights = self.weights_of(displacement)
        solution: Solution
        if sample.ratios:
            solution = self._layered(displacement, weights, sample, is_corrected=is_corrected)
        elif self._modal is None:
            solution = ZonalSolution(self.sensor, displacement, weights * self._certainty)
        else:
            solution = self._modal(displacement, weights=weights)
            if self.may_be_layered:  # results of all frames have the same modes
                solution = self._layered.in_these_modes(solution)
        return Wavefront.of(self.sensor, self.field, displacement, solution, sample)

    def contradicts(self, wavefront: Wavefront) -> bool:
        """True if the displacements of a wavefront contradict its layers: they may be of another sample."""
        return self.contradiction(wavefront) > wavefront.sample.allowed

    def contradiction(self, wavefront: Wavefront) -> float:
        """How far the displacements of a wavefront contradict its layers: 1 is what errors allow.

        It is the larger of two. A shift of the layers explains the rest of the displacements better, in `_CERTAIN`
        standard errors. Any wavefront explains more of the displacements, in misfits that a search accepts.
        """
        if (made := self._of(wavefront.displacement)) is not self:
            return made.contradiction(wavefront)
        solution, is_blind = wavefront.solution, self.hidden > 0
        if not isinstance(solution, ModalSolution) or solution.shift_sigmas is None:
            return 0.0
        shift, by_chance = solution.shift_sigmas() / _CERTAIN, 1 + _CERTAIN * math.sqrt(2 / solution.freedom)
        if solution.noise <= by_chance + systematic_misfit(is_blind=is_blind) ** 2 * solution.energy:
            return shift  # and any wavefront, which costs another solve, cannot explain much more
        free = cast("ModalSolution", self._solve(wavefront.displacement, FREE).solution).noise
        unexplained = solution.noise - by_chance * free, free - by_chance
        beyond, not_noise = (math.sqrt(max(each, 0.0) / solution.energy) for each in unexplained)
        return max(shift, beyond / systematic_misfit(not_noise, is_blind=is_blind))

    def registration_for(self, reference: Image) -> RegistrationMethod:
        """Prepare the same registration for another reference (row, column), counts above the dark."""
        return self._method(self._cut(reference), self.registration)

    @property
    def hidden(self) -> int:
        """Number of displacements of the warp that the mask does not show lenslet by lenslet."""
        return self._prepared.hidden

    @property
    def brightness_terms(self) -> int:
        """Number of polynomials over the field in which the brightness of a subimage may vary."""
        return 1 if self._prepared.warps is None else self._prepared.warps.brightness_terms

    def weights_of(self, displacement: Displacement) -> Floats:
        """Weights relative to the reference's, (lenslet_row, lenslet_column); all 1 if the noise is unknown."""
        if self.noise is None:
            return np.ones(displacement.valid.shape)
        return relative_weights(_variance(displacement), self._expected).reshape(displacement.valid.shape)

    @cached_property
    def smooth(self) -> ModalSolver:
        """Solver with all Legendre modes that the lattice carries; refinement models wavefronts by them."""
        has_them = self.reconstruction.basis == "legendre" and self.reconstruction.pupil_modes is None
        return self._modal if self._modal is not None and has_them else self._solver("legendre", None)

    def layers(self, displacement: Displacement) -> FrameEquations:
        """A frame's displacements, to which layers at any distance can be fitted."""
        if (made := self._of(displacement)) is not self:
            return made.layers(displacement)
        return FrameEquations(self._layered.solver, displacement, self.weights_of(displacement))

    @cached_property
    def _layered(self) -> LayeredWavefronts:
        modes = self._prepared.at_rest.modes
        solver = LayerSolver(self.sensor, self.field, modes, self.smooth, hidden=self.hidden)
        layer_modes = LayerModes(solver.degree, self.sensor, self.field, modes)
        return LayeredWavefronts(solver, layer_modes, self._prepared.parameters)

    def _method(self, reference: ReferenceSubimages, settings: RegistrationSettings) -> RegistrationMethod:
        own = self._own.registration
        if own is None:
            # Without known noise a frame does not show whether its sample absorbs.
            needs_model = settings.fits_warps and self.noise and not self.field.neglect_propagation
            model = self._model[0] if needs_model else None
            return prepare_registration(reference, settings, self.field, model, absorbs=self._absorbs)
        method: RegistrationMethod = _called("an own registration", None, own, reference, self.field)
        return method

    def _choose(self, light: Image, registration: RegistrationSettings) -> _Registration:
        """Prepare the registration for the reference's light; choose the warp if none is set."""

        @cache
        def prepare(warp: Warp) -> _Registration:
            settings = replace(registration, warp=warp)
            method = self._method(self.subimages, settings)
            warps = method if isinstance(method, WarpRegistration) else None
            unsaturated = np.zeros(light.shape, np.bool_)
            if self._own.registration is None:
                return _Registration(settings, method, method(light, saturated=unsaturated), warps)
            what = "a prepared own registration"
            found = _called(what, Displacement, method, light, saturated=unsaturated, start=None)
            _require_shape(f"coefficients of {what}", np.shape(found.coefficients)[:2], self.sensor)
            return _Registration(settings, method, found, warps)

        if registration.warp is not None or not registration.fits_warps:
            return prepare(registration.warp or "quadratic")
        if self.reconstruction.method == "modal" and not registration.rotation:
            widest = prepare(_CHOSEN_WARPS[-1])
            # Layers tie its parameters together, so that noise does not grow. What the mask hides has the prior's error
            # bars; those of a warp that it shows would leave out what the warp leaves out.
            if self._assumes_layers(registration) or (widest.hidden > 0 and not self.field.neglect_propagation):
                return widest
        # Warps that rotate and bend more than quadratic ones amplify noise.
        warps = _CHOSEN_WARPS[: 2 if registration.rotation else None]
        return prepare(min(warps, key=lambda warp: self._expected_error_rad2(warp, prepare(warp))))

    def _expected_error_rad2(self, warp: Warp, prepared: _Registration) -> float:
        """Mean expected square error of the views with a warp, by noise and systematic error, lenslets alike."""
        at_rest, parameters, sensor = prepared.at_rest, prepared.parameters, self.sensor
        if prepared.hidden or not at_rest.valid.any():  # nothing determines it
            return math.inf
        covariance = np.mean(at_rest.covariance[at_rest.valid], axis=0)
        everywhere = replace(
            at_rest,
            coefficients=np.zeros_like(at_rest.coefficients),
            covariance_source=np.broadcast_to(covariance, at_rest.covariance.shape),
            # a few lit lenslets could not carry the modes
            outcome=np.full_like(at_rest.outcome, LensletStatus.CONVERGED),
        )
        lattice_count = len(pupil_modes(sensor, "legendre", None).degree)
        modes = pupil_modes(sensor, "legendre", min(NOISE_MODES, lattice_count))
        layered = layered_wavefronts(sensor, modes, at_rest.modes, parameters)
        gradients = MeanGradients(sensor, parameters)
        solver = ModalSolver(modes, gradients, parameters, everywhere.covariance, layered=layered)
        noise = np.nanmean(Wavefront.of(sensor, self.field, everywhere, solver(everywhere)).sigma() ** 2)
        return float(noise) + _SYSTEMATIC_RAD[warp] ** 2

    @cached_property
    def _model(self) -> tuple[LensletModel | None, str]:
        """Model of the reference's lenslets, or why there is none although it is wanted."""
        if self._lenslet_model is None:
            return None, ""
        try:
            return fitting_model(self._lenslet_model, self.subimages), ""
        except ReconstructionError as error:
            return None, str(error)

    def _respond(self) -> tuple[Sensitivity, str]:
        """Response of the registration, or mean gradients and why a wanted response is missing."""
        warps = self._prepared.warps
        problem = ""
        is_wanted = self.reconstruction.response and not self.registration.rotation  # it holds for gradients only
        if is_wanted and warps is not None:
            model, problem = self._model
            if model is not None:
                return Response(self.sensor, linear_response(warps, model)), ""
            problem = problem and f"mean gradients replace the response of the registration: {problem}"
        return MeanGradients(self.sensor, self._prepared.parameters if warps is None else warps.alike), problem

    def _solver(self, basis: PupilBasis, count: int | None) -> ModalSolver:
        """Solver with that many pupil modes; None: all that the lattice carries, with the prior."""
        at_rest, parameters = self._prepared.at_rest, self._prepared.parameters
        lenslets = np.count_nonzero(at_rest.valid)
        if count is not None and 0 < lenslets < count:  # known before minutes of preparation
            raise TooManyModes(int(lenslets), count)
        own = self._own.basis if basis == self.reconstruction.basis else None
        if own is None:
            modes = pupil_modes(self.sensor, basis, count)
        else:
            modes = _called("an own basis", PupilModes, own, self.sensor, count)
            _require_shape("values of an own basis", np.shape(modes.values)[1:], self.sensor)
        has_prior = count is None or self.hidden > 0  # else nothing determines what the mask hides
        # Conserved flux shows all displacements, so that their systematic errors are not spread as noise would be.
        is_unknown = self.noise is None and self.field.neglect_propagation
        return ModalSolver(
            modes,
            self._sensitivity,
            parameters,
            at_rest.covariance * (0.0 if is_unknown else 1.0),
            layered=layered_wavefronts(self.sensor, modes, at_rest.modes, parameters),
            field_degree=at_rest.modes.degree if has_prior else None,
        )


def _why_lost(outcome: LensletStatuses) -> str:
    """Probable cause, if nearly all lenslets are lost."""
    counts = np.bincount(outcome.ravel(), minlength=len(LensletStatus)).tolist()
    left, saturated = counts[LensletStatus.LEFT_CELL], counts[LensletStatus.SATURATED]
    many = (outcome.size - counts[LensletStatus.ABSENT]) / 4
    if saturated > many:
        return f"{saturated} are saturated, {TOO_BRIGHT}"
    if left > many:
        return f"{left} subimages have left their cells, the aberration is beyond the dynamic range"
    unlike = counts[LensletStatus.DIVERGED]
    return f"{unlike} subimages look different: check the mask, the focus, and what covers the beam"


def _variance(displacement: Displacement) -> Floats:
    """Mean variance of each lenslet's coefficients and their systematic error, px^2, (L,)."""
    return np.asarray(displacement.mean_variance.ravel() + SYSTEMATIC_PX**2)
