"""Base class of controllers; docs/how-to/writing-a-controller.md has an example."""

import math
from abc import ABC, abstractmethod
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

from msgspec import Meta, Struct

from fishd.controllers.quantities import quantities_of
from fishd.core.errors import ParameterError
from fishd.core.schema import note, unit
from fishd.core.signals import Observation

DEFAULT_DWELL_S, MAX_DWELL_S = 0.2, 2.0
"""Dwell for the servo of Fu et al., and the largest permitted one [s]."""


class ChatterSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings for a policy that reverses too fast."""

    dwell: Annotated[
        Annotated[float, Meta(ge=0, le=MAX_DWELL_S)] | Literal["auto"],
        unit(
            "s",
            "Shortest time between two reversals of ppo, rounded up to whole ticks; earlier "
            "reversals are held back. 0 holds none back; auto: the time that the servo of section "
            "plant takes for a reversal.",
        ),
    ] = "auto"
    patience: Annotated[
        float,
        unit(
            "s",
            "Time after which a policy that keeps reversing too fast is replaced.",
            ge=0.2,
            le=600,
            usual=60,
        ),
    ] = 2.0
    fallback: Annotated[
        Literal["swing", "fault"], note("Replacement: the controller swing, or mode fault.")
    ] = "swing"


Amplitude = Annotated[float, Meta(gt=0, le=math.pi)] | None
"""Type of a parameter `amplitude` [rad]; None for the robot's limit: see `amplitude_of`."""


class Limits(Struct, frozen=True):
    """Limits of the loop for a controller."""

    amplitude: float
    """Φ: angles beyond ±Φ are clamped by the guard [rad]."""
    tick: float
    """Period of the loop [s]."""
    scaled: bool = False
    """Whether the fin velocity is in rad/s, from a model of the fish, not up to an unknown
    scale."""
    virtual: bool = False
    """Whether time stops during `update`, so that a controller may wait without limit."""
    dwell: float = DEFAULT_DWELL_S
    """Shortest time between two reversals of a policy; 0 holds none back [s]."""
    chatter: ChatterSettings = ChatterSettings()
    """Settings for a policy that reverses too fast; `dwell` above is the effective one."""
    tethered: bool = True
    """Whether the fish hangs from its force sensor, so that F_x is its thrust."""
    readings: tuple[str, ...] | None = None
    """Names of the readings of the sensors, which `Observation.readings` has; None if unknown."""
    thrust_coefficient: float | None = None
    """K of the observer's model of the fish: ratio of thrust to the mean square of the fin velocity
    [N s²/rad²]; None if the fin velocity is not from a model."""


class Likeness(NamedTuple):
    """Similarity of the wave of a controller to that of another one."""

    name: str
    """Name of the other controller."""
    ignored_parameters: frozenset[str]
    """Parameters that the other controller lacks, and that do not change the kind of wave."""


P = TypeVar("P", bound=Struct)


class Controller(ABC, Generic[P]):
    """Base of controllers, which choose the instruction angle once per tick.

    A subclass has `Parameters`, a frozen msgspec struct whose fields have bounds, unit and
    description, from which help texts, command-line options and documentation are generated.
    Everything slow (loading a file, warming up) belongs into `__init__`, which runs outside the
    tick. Internal values for display are declared with `quantity`.
    """

    Parameters: ClassVar[type[Struct]]
    same_wave_as: ClassVar[Likeness | None] = None
    """The other controller whose known thrust applies to the wave of this one, too."""

    uses_lateral_force: ClassVar[bool] = True
    """False if its angles depend neither on F_y nor on the fin velocity: then the controller may
    start although F_y is reversed and `estimator.reversed_fy` is refuse."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Raises TypeError if its quantities are invalid."""
        super().__init_subclass__(**kwargs)
        quantities_of(cls)

    def __init__(self, parameters: P, limits: Limits) -> None:
        """Raises `ParameterError` if the parameters do not fit the limits."""
        self.check(parameters, limits)
        self.parameters = parameters
        self.limits = limits

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Refuse parameters that are valid one by one but not on this robot.

        Raise `ParameterError`. The default has one such rule: no `amplitude` above Φ.
        """
        amplitude = getattr(parameters, "amplitude", None)
        if amplitude is not None and amplitude > limits.amplitude:
            raise ParameterError(
                f"amplitude: {amplitude:g} rad is beyond the robot's amplitude_limit, "
                f"{limits.amplitude:g} rad"
            )

    def activate(self, observation: Observation) -> None:
        """Take over: called in the tick of the switch, just before the first `update`.

        `observation.instruction_angle` is the current angle; start from it if that is reasonable.
        """

    def retune(self, parameters: P) -> None:
        """Apply new, already checked parameters while active; called between two updates."""
        self.parameters = parameters

    def close(self) -> None:
        """Release all resources: called once, when the controller is no longer used."""

    @abstractmethod
    def update(self, observation: Observation) -> float:
        """Return the instruction angle from now until the next tick [rad].

        Called once per tick; must return within half a period. An exception causes a fault, with
        the code `controller-error`, or with the code of a `ControllerFault`.
        """


def amplitude_of(parameters: Any, limits: Limits) -> float:
    """Return the amplitude [rad]: the parameter if it is given, else the limit of the robot."""
    amplitude: float | None = getattr(parameters, "amplitude", None)
    return limits.amplitude if amplitude is None else amplitude
