"""`swing`: reverse when the fin slows down. The paper's model-free control (Fu et al.)."""

from typing import Annotated, ClassVar, Literal

from msgspec import Meta, Struct

from fishd.controllers.base import Amplitude, Controller, Likeness, Limits, amplitude_of
from fishd.controllers.criterion_search import BEGIN, LADDER, CriterionSearch, Phase
from fishd.controllers.quantities import quantity
from fishd.controllers.reversal import Reversal
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation

LONGEST_TICK = 0.15
"""Of C auto: with longer ones a half beat has two or three, and its ripple cannot be told [s]."""
BLIND = 4
"""With a lead, so many half beats come first that C = 0.6 ends: the speed of a fin that only begins
to swing is not predicted."""


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
            usual=5,
        ),
    ] = 1.0
    lead: Annotated[
        float,
        unit(
            "s",
            "Compare the speed predicted this far ahead, from how it changes now; the first two "
            "beats are with C = 0.6 and without it. C auto finds its own.",
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
    # A lead changes no more than the size of the wave; and `thrust`, which has none, swims alike.
    swims_like: ClassVar[Likeness | None] = Likeness("swing", frozenset({"lead"}))
    top_speed: float = quantity(
        "1",
        "The fin's highest speed in a half beat: of this one, once past it; before, of the last.",
    )
    reversal_speed: float = quantity("1", "C times `top_speed`: the tail reverses when so slow.")
    since_reversal: float = quantity("s", "Time since the last reversal.")
    criterion: float | None = quantity("1", "With C auto: the C in use, or on trial.")
    lead: float | None = quantity("s", "With C auto: how far ahead the speed is predicted.")
    halfway: float | None = quantity(
        "1", "With C auto: 1 where the two sides of a beat go by two C, or leads, in turn; else 0."
    )
    searching: float | None = quantity("1", "With C auto: 1 while others are tried, else 0.")
    ripple: float | None = quantity("N", "With C auto: ripple of F_x in the latest beats.")

    def __init__(self, parameters: SwingParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._reversal = Reversal(limits)
        self._reversals = 0 if parameters.lead else BLIND
        self.top_speed = self.reversal_speed = self.since_reversal = 0.0
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
        self._amplitude = amplitude_of(parameters, self.limits)
        if parameters.C != "auto":
            self._search = None
            self.criterion = self.lead = self.halfway = self.searching = self.ripple = None
        elif self._search is None:
            self._search = CriterionSearch()

    def activate(self, observation: Observation) -> None:
        """Push on towards the side of the present angle; from rest, towards plus."""
        self._reversal.begin(observation.instruction_angle)

    def update(self, observation: Observation) -> float:
        """Plus or minus the amplitude [rad]."""
        C, lead = self._rung(observation)
        reversal = self._reversal
        before = reversal.direction
        reversal.update(observation, C, lead, self.parameters.longest_half_period)
        if reversal.direction != before:
            self._reversals += 1
        self.top_speed = reversal.top_speed
        self.reversal_speed = reversal.reversal_speed
        self.since_reversal = reversal.since_reversal
        return reversal.direction * self._amplitude

    def _rung(self, observation: Observation) -> tuple[float, float]:
        """Return C and the lead [s] of this tick: the parameters, or those of the search."""
        parameters, search = self.parameters, self._search
        if parameters.C != "auto":
            return (parameters.C, parameters.lead) if self._reversals >= BLIND else LADDER[BEGIN]
        assert search
        search.update(observation.fx, observation.fy, observation.dt, self._reversal.direction)
        self.criterion, self.lead = rung = search.rung
        self.halfway = float(search.halfway)
        self.searching = float(search.phase is not Phase.WATCH)
        self.ripple = search.ripple
        return rung
