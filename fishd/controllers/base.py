"""What a controller is. docs/how-to/writing-a-controller.md works through an example."""

import math
from abc import ABC, abstractmethod
from typing import Annotated, Any, ClassVar, Generic, Literal, NamedTuple, TypeVar

from msgspec import Meta, Struct

from fishd.controllers.quantities import quantities_of
from fishd.core.errors import ParameterError
from fishd.core.schema import note, unit
from fishd.core.signals import Observation

DWELL, LONGEST_DWELL = 0.2, 2.0
"""Of a fish whose servo is that of Fu et al., and the longest there may be [s]."""


class ChatterSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What becomes of a policy that reverses too fast."""

    dwell: Annotated[
        Annotated[float, Meta(ge=0, le=LONGEST_DWELL)] | Literal["auto"],
        unit(
            "s",
            "Shortest time between two reversals of ppo, in whole ticks, rounded up; those that "
            "would come sooner are held back. 0 holds none back; auto: what the servo of section "
            "plant takes for a reversal.",
        ),
    ] = "auto"
    patience: Annotated[
        float,
        unit(
            "s",
            "Time after which a policy that keeps reversing too fast loses command.",
            ge=0.2,
            le=600,
            usual=60,
        ),
    ] = 2.0
    fallback: Annotated[
        Literal["swing", "fault"], note("What comes then: swing takes over, or mode fault.")
    ] = "swing"


Amplitude = Annotated[float, Meta(gt=0, le=math.pi)] | None
"""Type of a parameter `amplitude` [rad]; None for all that the robot grants: see `amplitude_of`."""


class Limits(Struct, frozen=True):
    """What the loop grants a controller."""

    amplitude: float
    """Φ: commands beyond ±Φ are clamped by the guard [rad]."""
    tick: float
    """Period of the loop [s]."""
    scaled: bool = False
    """The fin velocity is in rad/s, by the model of the fish, not up to an unknown scale."""
    virtual: bool = False
    """Time stands still while a controller thinks, so it may wait for others as long as it must."""
    dwell: float = DWELL
    """Shortest time between two reversals of a policy; 0 holds none back [s]."""
    chatter: ChatterSettings = ChatterSettings()
    """What becomes of a policy that reverses too fast; the dwell that holds is the one above."""
    tethered: bool = True
    """The fish hangs from its force sensor, so that F_x is its thrust."""
    thrust_coefficient: float | None = None
    """K of the fish that the observer believes in: thrust over the mean square of its fin velocity
    [N s²/rad²]; None where the fin velocity is of no model."""


class Likeness(NamedTuple):
    """Of the wave of a controller to that of another one."""

    name: str
    """Of the other one."""
    but_for: frozenset[str]
    """Parameters that the other one has not, and that are not of the kind of wave."""


P = TypeVar("P", bound=Struct)


class Controller(ABC, Generic[P]):
    """Chooses the instruction angle, once a tick.

    A subclass names its `Parameters`, a frozen msgspec struct whose fields carry bounds, unit and
    description: help texts, command-line options and documentation are made from it. Everything
    slow (loading a file, warming up) belongs into `__init__`, which runs outside the tick. What
    it wants to show of its inside is a `quantity`.
    """

    Parameters: ClassVar[type[Struct]]
    swims_like: ClassVar[Likeness | None] = None
    """What is known of the thrust of that other controller's wave holds for this one's, too."""

    uses_lateral_force: ClassVar[bool] = True
    """False where neither F_y nor the fin velocity changes what it commands: then it may start
    although F_y is known to be reversed and `estimator.reversed_fy` is refuse."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Raises TypeError where its quantities cannot be shown."""
        super().__init_subclass__(**kwargs)
        quantities_of(cls)

    def __init__(self, parameters: P, limits: Limits) -> None:
        """Raises `ParameterError` when the parameters do not fit the limits."""
        self.check(parameters, limits)
        self.parameters = parameters
        self.limits = limits

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Refuse parameters that are valid one by one but not on this robot.

        Raises `ParameterError`. The default knows one such rule: no `amplitude` above Φ.
        """
        amplitude = getattr(parameters, "amplitude", None)
        if amplitude is not None and amplitude > limits.amplitude:
            raise ParameterError(
                f"amplitude: {amplitude:g} rad is beyond the robot's amplitude_limit, "
                f"{limits.amplitude:g} rad"
            )

    def activate(self, observation: Observation) -> None:
        """Take over: called in the tick of the switch, just before the first `update`.

        `observation.instruction_angle` is the present angle; start from it where that makes sense.
        """

    def retune(self, parameters: P) -> None:
        """Take new, already checked parameters while running; called between two updates."""
        self.parameters = parameters

    def warm_up(self) -> None:
        """Do what `update` does, without any effect, so that it finds warm caches.

        Called up to once a tick, just before it; only what takes `update` long from cold is worth
        it.
        """

    def close(self) -> None:
        """Let go of everything: called once, when it is out of command for good."""

    @abstractmethod
    def update(self, observation: Observation) -> float:
        """The instruction angle from now until the next tick [rad].

        Called once a tick; must return within half a period. Whatever it raises is a fault, of the
        code `controller-error`, or of its own where that is a `ControllerFault`.
        """


def amplitude_of(parameters: Any, limits: Limits) -> float:
    """The present amplitude: the parameter where it is given, else all that the robot grants."""
    amplitude: float | None = getattr(parameters, "amplitude", None)
    return limits.amplitude if amplitude is None else amplitude
