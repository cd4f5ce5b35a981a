"""`swing`: reverse when the fin slows down. The paper's model-free control (Fu et al.)."""

from typing import Annotated, ClassVar, Literal

from msgspec import Meta, Struct

from fishd.controllers.base import Amplitude, Controller, Likeness, Limits, amplitude_of
from fishd.controllers.criterion_search import LADDER, START_INDEX, CriterionSearch, Phase
from fishd.controllers.quantities import quantity
from fishd.controllers.reversal import Reversal
from fishd.core.errors import ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation

MAX_TICK_S = 0.15
"""Longest tick for C auto: with longer ones the ripple of a half beat cannot be measured [s]."""
PREDICTION_DELAY_HALF_BEATS = 4
"""Number of half beats at the start during which C = 0.6 is used instead of a lead, because the
speed of a fin that has just started cannot be predicted."""


class SwingParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `swing`."""

    C: Annotated[
        Annotated[float, Meta(ge=0, le=1)] | Literal["auto"],
        unit(
            "1",
            "Reverse when the fin's speed falls to C times its last maximum; auto: begin with 0.6, "
            "and search for the largest thrust.",
            step=0.05,
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
            "Reverse after this time even if the fin does not slow down.",
            gt=0,
            le=10,
            usual=5,
            step=0.05,
        ),
    ] = 1.0
    lead: Annotated[
        float,
        unit(
            "s",
            "Compare the speed that is predicted this far ahead from its current slope; the first "
            "two beats use C = 0.6 without a lead. C auto finds its own lead.",
            ge=0,
            le=1,
        ),
    ] = 0.0


class Swing(Controller[SwingParameters]):
    """Reverse the tail when the fin slows to a fraction C of its last top speed.

    It needs no model of the fish: only the shape of the fin velocity matters, so any positive scale
    cancels. The resulting square wave is close to the optimum.
    """

    Parameters = SwingParameters
    # A lead changes only the size of the wave; `thrust`, which has none, has the same wave.
    same_wave_as: ClassVar[Likeness | None] = Likeness("swing", frozenset({"lead"}))
    top_speed: float = quantity(
        "1", "Top speed of the fin in this half beat, or, until it is reached, in the previous one."
    )
    reversal_speed: float = quantity("1", "C times `top_speed`: the tail reverses at this speed.")
    since_reversal: float = quantity("s", "Time since the last reversal.")
    criterion: float | None = quantity("1", "With C auto: the C in use or on trial.")
    lead: float | None = quantity("s", "With C auto: time by which the speed is predicted ahead.")
    halfway: float | None = quantity(
        "1", "With C auto: 1 if the two sides of a beat use two values of C or lead; else 0."
    )
    searching: float | None = quantity("1", "With C auto: 1 while other values are tried, else 0.")
    ripple: float | None = quantity("N", "With C auto: ripple of F_x in the latest beats.")
    clear: float | None = quantity(
        "1", "With C auto: 1; 0 while the ripple does not rise above the noise, so that C stays."
    )

    def __init__(self, parameters: SwingParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._reversal = Reversal(limits)
        self._reversals = 0 if parameters.lead else PREDICTION_DELAY_HALF_BEATS
        self.top_speed = self.reversal_speed = self.since_reversal = 0.0
        self._search: CriterionSearch | None = None
        self.retune(parameters)

    @classmethod
    def check(cls, parameters: SwingParameters, limits: Limits) -> None:
        """Check the amplitude, and that C auto has a tethered fish, short ticks and no lead.

        Raise `ParameterError`.
        """
        super().check(parameters, limits)
        if parameters.C != "auto":
            return
        if parameters.lead:
            raise ParameterError(
                f"lead: {parameters.lead:g} s is not valid with C auto, which finds its own; omit "
                "it, or give C a number in [0, 1]",
                ("lead",),
            )
        if not limits.tethered:
            raise ParameterError(
                "C: auto uses the ripple of F_x, which is the thrust of a tethered fish only; a "
                "number in [0, 1] is needed"
            )
        if limits.tick > MAX_TICK_S:
            raise ParameterError(
                f"C: auto needs ticks of {MAX_TICK_S:g} s at most, not {limits.tick:g} s, to "
                "measure the ripple of F_x; a number in [0, 1] is needed"
            )

    def retune(self, parameters: SwingParameters) -> None:
        """Apply new parameters; setting C to auto starts a search, other changes keep it."""
        super().retune(parameters)
        self._amplitude = amplitude_of(parameters, self.limits)
        if parameters.C != "auto":
            self._search = None
            self.criterion = self.lead = self.halfway = self.searching = self.ripple = None
            self.clear = None
        elif self._search is None:
            self._search = CriterionSearch()

    def activate(self, observation: Observation) -> None:
        """Push towards the side of the current angle; from rest, towards plus."""
        self._reversal.begin(observation.instruction_angle)

    def update(self, observation: Observation) -> float:
        """Return plus or minus the amplitude [rad]."""
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
            if self._reversals < PREDICTION_DELAY_HALF_BEATS:
                return LADDER[START_INDEX]
            return parameters.C, parameters.lead
        assert search
        search.update(observation.fx, observation.fy, observation.dt, self._reversal.direction)
        self.criterion, self.lead = rung = search.rung
        self.halfway = float(search.halfway)
        self.searching = float(search.phase is not Phase.WATCH)
        self.ripple, self.clear = search.ripple, float(search.is_clear)
        return rung
