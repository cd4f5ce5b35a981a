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

if TYPE_CHECKING:  # numpy and onnxruntime are imported with the first policy
    from fishd.controllers.policy.card import Card
    from fishd.controllers.policy.runtime import Network

ROUNDING = 1e-5
"""Largest output of a network that counts as zero, since its sums are rounded."""


class PpoParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `ppo`."""

    policy: Annotated[
        str,
        unit(
            "1",
            "Name or file of the policy; 'fishctl policies' lists the named ones. Measure it on "
            "your fish first, with 'fishctl compare POLICY swing:C=auto --on live': on unknown "
            "simulated fish, default-fish had 98 % of the thrust of the best square wave (median) "
            "and 87 % on the worst one, policies for another fish 95 and 60 %.",
            min_length=1,
            max_length=4096,
            pattern=PRINTABLE,
            file=library.SUFFIX,
        ),
    ]


class Ppo(Controller[PpoParameters]):
    """Follow a learned policy: measure it on your fish first (fishctl compare --on live).

    A small network chooses each instruction angle. On an unknown fish it may have far less thrust
    than the best square wave; `docs/reference/policies.md` has the measured values. The policy file
    is written by `fishctl learn export`: an ONNX model with a card that describes its input, tick
    and output. Reversals sooner than `chatter.dwell` are held back; a policy that keeps commanding
    them is replaced by another controller.
    """

    Parameters = PpoParameters
    action: float = quantity("1", "Output of the network, before it is clipped to [-1, 1].")
    held: float = quantity("1", "Fraction of the latest ticks in which a reversal was held back.")

    def __init__(self, parameters: PpoParameters, limits: Limits) -> None:
        """Read, check and warm up the policy."""
        from fishd.controllers.policy.card import History, is_even

        self.parameters = parameters  # without super(), which would read the policy twice
        self.limits = limits
        card, self._network = _open(parameters, limits)
        self._history = History(card.observation, card.window, self._network.row)
        names = [feature.name for feature in card.observation] * card.history
        self._odd = [index for index, name in enumerate(names) if not is_even(name)]
        """Indices of the inputs that change sign for a mirrored fish."""
        self._amplitude = card.amplitude
        self._limit = DwellLimit(limits.dwell, limits, card.amplitude)

    @classmethod
    def check(cls, parameters: PpoParameters, limits: Limits) -> None:
        """Refuse a file that is not a policy, or one for another tick or amplitude."""
        _open(parameters, limits)

    def activate(self, observation: Observation) -> None:
        """Take over as if the tail had just reversed."""
        self._limit.activate(observation.instruction_angle)
        self._history.forget()

    def retune(self, parameters: PpoParameters) -> None:
        """Refuse: another policy must be loaded and warmed up outside the loop."""
        if parameters != self.parameters:
            raise ParameterError(
                "policy: it cannot change while ppo is active; activate ppo again with another "
                "policy"
            )

    def update(self, observation: Observation) -> float:
        """Return Φ times the network's output, clipped to ±1 [rad].

        A network with left-right symmetry returns zero if all its inputs but F_x are zero, such as
        at rest without noise; the fish is then pushed to plus. An output that is not finite is
        returned unchanged, which causes the fault `controller-error`.
        Raise `ControllerFault` with the code `chatter`; see `DwellLimit`.
        """
        self.action = action = self._choose(observation)
        if abs(action) < ROUNDING and not self._network.row[self._odd].any():
            action = 1.0
        elif math.isfinite(action):
            action = max(-1.0, min(1.0, action))
        instruction_angle = self._limit.apply(self._amplitude * action, observation.dt)
        self.held = self._limit.share
        return instruction_angle

    def _choose(self, observation: Observation) -> float:
        """Return the output of the network."""
        network = self._network
        self._history.push(observation)
        return network.run()


def _open(parameters: PpoParameters, limits: Limits) -> "tuple[Card, Network]":
    from fishd.controllers.policy.runtime import Network

    try:
        policy = library.open_policy(parameters.policy, limits)
        if policy.card.pictures:
            raise PolicyError(
                f"{policy.path}: it needs pictures, which this loop does not have; run it with "
                f"'fishctl agent {parameters.policy}', or in simulation with 'fishctl compare'"
            )
        return policy.card, Network(policy)
    except PolicyError as error:
        raise ParameterError(f"policy: {error}", ("policy",)) from None
