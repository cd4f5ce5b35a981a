"""`swing`: reverse when the fin slows down. The paper's model-free control (Fu et al.)."""

from collections import deque
from typing import Annotated, Literal

from msgspec import Meta, Struct

from fishd.controllers.base import Amplitude, Controller, Limits, amplitude_of
from fishd.controllers.criterion_search import BEGIN, LADDER, CriterionSearch, Phase, Rung
from fishd.controllers.quantities import quantity
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation

REFRACTORY = 0.05
"""Share of the longest half period in which noise, at small ticks, cannot cause a reversal."""


LONGEST_TICK = 0.15
"""Of C auto: with longer ones a half beat has two or three, and its ripple cannot be told [s]."""
BLIND = 4
"""With a lead, so many half beats come first that C = 0.6 ends: the speed of a fin that only begins
to swing is not foreseen."""
SLOPE_OVER = 0.05
"""The speed ahead is foreseen from its change over so long, or a tick where that is longer [s]."""


class SwingParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `swing`."""

    C: Annotated[
        Annotated[float, Meta(ge=0, le=1)] | Literal["auto"],
        unit(
            "1",
            "Reverse when the fin's speed falls to C times its last maximum; auto: begin with 0.6, "
            "and find what pushes most.",
        ),
    ] = 0.6
    amplitude: Annotated[
        Amplitude,
        unit("rad", "Instruction angle on either side; null: the robot's amplitude_limit."),
    ] = None
    longest_half_period: Annotated[
        float,
        unit(
            "s",
            "Reverse after this time even if the fin shows no sign of slowing down.",
            gt=0,
            le=10,
        ),
    ] = 1.0
    lead: Annotated[
        float,
        unit(
            "s",
            "Go by the speed that is foreseen so far ahead, if it goes on changing as it does; the "
            "first two beats are with C = 0.6. C auto finds its own.",
            ge=0,
            le=1,
        ),
    ] = 0.0


class Swing(Controller[SwingParameters]):
    """Reverse the tail when the fin slows to a fraction C of its last top speed.

    It knows nothing of the fish: only the shape of the fin velocity counts, so any positive scale
    cancels. The square wave that results is close to the best there is.
    """

    Parameters = SwingParameters
    top_speed: float = quantity(
        "1",
        "The fin's highest speed in a half beat: of this one, once past it; before, of the last.",
    )
    reversal_speed: float = quantity("1", "C times `top_speed`: the tail reverses when so slow.")
    since_reversal: float = quantity("s", "Time since the last reversal.")
    criterion: float | None = quantity("1", "With C auto: the C in use, or on trial.")
    lead: float | None = quantity("s", "With C auto: how far ahead the speed is foreseen.")
    searching: float | None = quantity("1", "With C auto: 1 while others are tried, else 0.")
    ripple: float | None = quantity("N", "With C auto: ripple of F_x in the latest beats.")

    def __init__(self, parameters: SwingParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._direction = 1.0
        self._top_speed = 0.0  # since the last reversal
        self.top_speed = 0.0
        self.reversal_speed = 0.0
        self.since_reversal = 0.0
        ticks = max(1, round(SLOPE_OVER / limits.tick))
        self._velocities: deque[float] = deque(maxlen=ticks + 1)
        self._reversals = 0 if parameters.lead else BLIND
        self._search: CriterionSearch | None = None
        self.retune(parameters)

    @classmethod
    def check(cls, parameters: SwingParameters, limits: Limits) -> None:
        """As for any controller; and C auto judges by F_x of a tethered fish, and by its shape.

        Raises `ParameterError`.
        """
        super().check(parameters, limits)
        if parameters.C != "auto":
            return
        if parameters.lead:
            raise ParameterError(
                f"lead: {parameters.lead:g} s is not valid with C auto, which finds its own; leave "
                "it out, or give C a number in [0, 1]",
                ("lead",),
            )
        if not limits.tethered:
            raise ParameterError(
                "C: auto goes by the ripple of F_x, which is the thrust of a tethered fish only; a "
                "number in [0, 1] is needed"
            )
        if limits.tick > LONGEST_TICK:
            raise ParameterError(
                f"C: auto needs ticks of {LONGEST_TICK:g} s at most, not {limits.tick:g} s, to see "
                "the ripple of F_x; a number in [0, 1] is needed"
            )

    def retune(self, parameters: SwingParameters) -> None:
        """Take new parameters; to set C to auto begins a search, to set anything else keeps it."""
        super().retune(parameters)
        if parameters.C != "auto":
            self._search = None
            self.criterion = self.lead = self.searching = self.ripple = None
        elif self._search is None:
            self._search = CriterionSearch()

    def activate(self, observation: Observation) -> None:
        """Push on towards the side of the present angle; from rest, towards plus."""
        self._direction = 1.0 if observation.instruction_angle >= 0 else -1.0

    def update(self, observation: Observation) -> float:
        """Plus or minus the amplitude [rad]."""
        rung = self._rung(observation)
        self.since_reversal += observation.dt
        parameters = self.parameters
        speed = self._direction * self._ahead(observation, rung.lead)
        slowed = self._top_speed > 0.0 and speed <= rung.C * self._top_speed
        self._top_speed = max(self._top_speed, speed)
        settled = self.since_reversal > REFRACTORY * parameters.longest_half_period
        # Half a tick early is nearer to the longest half period than half a tick late.
        overdue = self.since_reversal + 0.5 * self.limits.tick > parameters.longest_half_period
        reverses = (slowed and settled) or overdue
        if self._top_speed > 0.0 and (reverses or speed < self._top_speed):
            self.top_speed = self._top_speed
        if reverses:
            self._direction = -self._direction
            self._top_speed = 0.0
            self.since_reversal = 0.0
            self._reversals += 1
        self.reversal_speed = rung.C * self.top_speed
        return self._direction * amplitude_of(parameters, self.limits)

    def _ahead(self, observation: Observation, lead: float) -> float:
        """The fin velocity `lead` s from now, if it goes on changing as it does."""
        self._velocities.append(observation.fin_velocity)
        change = self._velocities[-1] - self._velocities[0]
        elapsed = observation.dt * max(1, len(self._velocities) - 1)
        return observation.fin_velocity + lead * change / elapsed

    def _rung(self, observation: Observation) -> Rung:
        """When to reverse: as the parameter says, or as the search has found."""
        if self.parameters.C != "auto":
            foresees = self._reversals >= BLIND
            return Rung(self.parameters.C, self.parameters.lead) if foresees else LADDER[BEGIN]
        assert self._search
        self._search.update(observation.fx, observation.dt, self._direction)
        rung = self._search.rung
        self.criterion, self.lead = rung
        self.searching = float(self._search.phase is not Phase.WATCH)
        self.ripple = self._search.ripple
        return rung
