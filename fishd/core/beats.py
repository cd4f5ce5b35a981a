"""Beats of the tail: from one upward reversal of the instruction angle to the next."""

from collections.abc import Iterable


class Reversals:
    """Detector of the reversals of the instruction angle; 0 keeps the previous side."""

    def __init__(self) -> None:
        self._side = 0.0

    def add(self, instruction_angle: float) -> int:
        """Return 1 for an upward reversal, −1 for a downward one, and 0 for none.

        instruction_angle: the next instruction angle [rad]
        """
        before = self._side
        if instruction_angle:
            self._side = 1.0 if instruction_angle > 0.0 else -1.0
        return int(self._side) if before and self._side != before else 0


def upward_reversals(angles: Iterable[float]) -> list[int]:
    """Return the indices of the angles with which a beat begins."""
    reversals = Reversals()
    return [
        index
        for index, instruction_angle in enumerate(angles)
        if reversals.add(instruction_angle) > 0
    ]
