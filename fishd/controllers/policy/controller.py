"""`ppo`: a learned policy from a policy file."""

import math
from typing import TYPE_CHECKING, Annotated

from msgspec import Struct

from fishd.controllers.base import Controller, Limits
from fishd.controllers.dwell import DwellLimit
from fishd.controllers.policy import library
from fishd.controllers.quantities import quantity
from fishd.core.errors import ParameterError, PolicyError
from fishd.core.schema import PRINTABLE, unit
from fishd.core.signals import Observation

if TYPE_CHECKING:  # numbers and onnxruntime are loaded with the first policy
    from fishd.controllers.policy.card import Card
    from fishd.controllers.policy.runtime import Network

_WARM_UPS = 3


class PpoParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `ppo`."""

    policy: Annotated[
        str,
        unit(
            "1",
            "What to follow; 'fishctl policies' lists those that have a name.",
            min_length=1,
            max_length=4096,
            pattern=PRINTABLE,
            file=library.SUFFIX,
        ),
    ]


class Ppo(Controller[PpoParameters]):
    """Follow a learned policy: a small network chooses each instruction angle.

    It is what `fishctl learn export` writes: an ONNX model with the card that says what it must be
    shown, at which tick, and what its output means. Reversals that come sooner than `chatter.dwell`
    are held back; a policy that insists on them is replaced by another controller.
    """

    Parameters = PpoParameters
    action: float = quantity("1", "What the network put out, before it is cut to -1 to 1.")
    held: float = quantity("1", "In what share of the latest ticks a reversal was held back.")

    def __init__(self, parameters: PpoParameters, limits: Limits) -> None:
        """Reads, checks and warms up the policy."""
        from fishd.controllers.policy.card import History

        self.parameters = parameters  # without super(), which would do all of it twice
        self.limits = limits
        card, self._network = _open(parameters, limits)
        self._history = History(card.observation, card.window, self._network.row)
        self._amplitude = card.amplitude
        self._limit = DwellLimit(limits.dwell, limits, card.amplitude)
        self._latest = Observation(0.0, limits.tick, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @classmethod
    def check(cls, parameters: PpoParameters, limits: Limits) -> None:
        """Refuse a file that is not a policy, or one for another tick or amplitude."""
        _open(parameters, limits)

    def activate(self, observation: Observation) -> None:
        """Take over as if the tail had reversed just now."""
        self._limit.activate(observation.instruction_angle)
        self._history.forget()
        self._latest = observation

    def retune(self, parameters: PpoParameters) -> None:
        """Refuse: another policy must be loaded and warmed up outside the loop."""
        if parameters != self.parameters:
            raise ParameterError(
                "policy: it cannot change in flight; start the controller again, with another one"
            )

    def warm_up(self) -> None:
        """Choose as in the latest tick, a few times: the first brings the network to the caches."""
        for _ in range(_WARM_UPS):
            self._choose(self._latest)

    def update(self, observation: Observation) -> float:
        """Return Φ times the network's output, which is cut to ±1 [rad].

        A network with left-right symmetry returns zero where all its inputs are zero, as at rest
        without noise; the fish is then pushed to plus.
        An output that is not finite is returned as it is, which is the fault `controller-error`.
        Raises `ControllerFault` with the code `chatter`; see `DwellLimit`.
        """
        self._latest = observation
        self.action = action = self._choose(observation)
        if action == 0.0 and not self._network.row.any():
            action = 1.0
        elif math.isfinite(action):
            action = max(-1.0, min(1.0, action))
        angle = self._limit.apply(self._amplitude * action, observation.dt)
        self.held = self._limit.share
        return angle

    def _choose(self, observation: Observation) -> float:
        """What the network puts out."""
        network = self._network
        self._history.push(observation)
        return network.run()


def _open(parameters: PpoParameters, limits: Limits) -> "tuple[Card, Network]":
    from fishd.controllers.policy import opening
    from fishd.controllers.policy.runtime import Network

    try:
        policy = opening.read(parameters.policy, limits)
        if policy.card.pictures:
            raise PolicyError(
                f"{policy.path}: it sees pictures, which this loop does not have; let it swim with "
                f"'fishctl agent {parameters.policy}', or in simulation with 'fishctl compare'"
            )
        return policy.card, Network(policy)
    except PolicyError as error:
        raise ParameterError(f"policy: {error}", ("policy",)) from None
