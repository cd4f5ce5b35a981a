"""Scripts of the emulated pigpiod: small programs that run inside it.

Only the instructions of fishd's countdown are emulated. Scripts have no thread: each access to
their effects first runs them up to the current time.
"""

import logging
import math
import re
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

from fishd.virtual.pi.pigpiod import errors
from fishd.virtual.pi.pigpiod.errors import PigpioError, check

log = logging.getLogger(__name__)

PARAMETER_COUNT = 10
"""Number of parameters of a script."""
INSTRUCTION_TIME = 1e-6
"""Duration of an instruction [s]; it has the same order of magnitude on a Pi 4."""
INITIALISING_TIME = 1e-3
"""Time from the storage of a script until it can run [s]."""
MAX_DELAY_MS = 60_000
"""Longest delay of the instruction `mils` [ms]."""
MAX_BURST = 5000
"""Largest number of instructions without a delay; then a script skips the remaining time."""

# Kinds of operands by instruction: n: number, v: number or parameter, p: parameter.
_OPERANDS = {"tag": "n", "jmp": "n", "jz": "n", "jnz": "n"}
_OPERANDS |= {"mils": "v", "lda": "v", "cmp": "v", "dcr": "p", "s": "vv"}
_WORDS = {"n": re.compile(r"()(\d+)"), "v": re.compile(r"(p?)(\d+)"), "p": re.compile(r"(p)(\d+)")}


class State(IntEnum):
    """Result of `script_status`; a script in a delay is running."""

    INITIALISING = 0
    HALTED = 1
    RUNNING = 2


class Operand(NamedTuple):
    """Number, or number of a parameter."""

    parameter: bool
    number: int


class Instruction(NamedTuple):
    """One step of a script; the operand of a jump is its target position."""

    name: str
    operands: tuple[Operand, ...]


def parse(text: str) -> tuple[Instruction, ...]:
    """Return the instructions of a script.

    Raises `PigpioError`: BAD_SCRIPT_CMD for an instruction that is not emulated or an invalid
    operand, DUP_TAG, and BAD_TAG for a jump to an unknown tag.
    """
    words = text.lower().split()
    program: list[Instruction] = []
    tag_positions: dict[int, int] = {}
    while words:
        name = words.pop(0)
        if name not in _OPERANDS:
            if name.isalpha():  # fishd stores "?" to see whether pigpiod knows scripts at all
                log.warning(
                    "emulated pigpiod: script refused: '%s' is not one of the emulated "
                    "instructions: %s",
                    *(name, ", ".join(_OPERANDS)),
                )
            raise PigpioError(errors.BAD_SCRIPT_CMD)
        operands = tuple(_operand(words.pop(0) if words else "", k) for k in _OPERANDS[name])
        if name == "tag":
            check(operands[0].number not in tag_positions, errors.DUP_TAG)
            tag_positions[operands[0].number] = len(program)
        else:
            program.append(Instruction(name, operands))
    for position, (name, operands) in enumerate(program):
        if name.startswith("j"):
            check(operands[0].number in tag_positions, errors.BAD_TAG)
            target = Operand(False, tag_positions[operands[0].number])
            program[position] = Instruction(name, (target,))
    return tuple(program)


def _operand(word: str, kind: str) -> Operand:
    match = _WORDS[kind].fullmatch(word)
    if not match or int(match[2]) >= (PARAMETER_COUNT if match[1] else 2**31):
        raise PigpioError(errors.BAD_SCRIPT_CMD)
    return Operand(bool(match[1]), int(match[2]))


class Script:
    """Stored script: its program, its parameters and its position.

    Times are seconds of the daemon's clock and must not decrease from call to call.
    """

    def __init__(self, text: str, servo: Callable[[float, int, int], int], time: float) -> None:
        """`servo`: executes the instruction `s` with time [s], GPIO and width [µs].

        Raises `PigpioError` as `parse` does.
        """
        self._program = parse(text)
        self._servo = servo
        self._ready = time + INITIALISING_TIME
        self._accumulator = self._flag = self._position = self._burst = 0
        self.parameters = [0] * PARAMETER_COUNT
        self.time = math.inf
        """Time of the next instruction [s]; infinity while halted."""

    def state(self, time: float) -> State:
        """Return the state at a time [s] up to which the script has run."""
        if time < self._ready:
            return State.INITIALISING
        return State.HALTED if self.time == math.inf else State.RUNNING

    def update(self, parameters: tuple[int, ...]) -> int:
        """Overwrite the first parameters, also while the script runs."""
        self.parameters[: len(parameters)] = parameters
        return 0

    def start(self, time: float, parameters: tuple[int, ...]) -> int:
        """Start from the beginning; a running script only gets the parameters.

        Raises `PigpioError` SCRIPT_NOT_READY while the script is initialising.
        """
        state = self.state(time)
        check(state is not State.INITIALISING, errors.SCRIPT_NOT_READY)
        self.update(parameters)
        if state is State.HALTED:
            self._accumulator = self._flag = self._position = self._burst = 0
            self.time = time
        return 0

    def run(self, until: float) -> None:
        """Execute the instructions that are due at or before a time [s]."""
        while self.time <= until:
            if self._burst >= MAX_BURST:
                self._burst = 0
                self.time = math.nextafter(until, math.inf)
            elif self._position < len(self._program):
                self._step()
            else:
                self.time = math.inf

    def _step(self) -> None:
        name, operands = self._program[self._position]
        first, *other_values = (self.parameters[n] if parameter else n for parameter, n in operands)
        now = self.time
        self.time += INSTRUCTION_TIME
        self._burst += 1
        self._position += 1
        if name == "lda":
            self._accumulator = first
        elif name == "cmp":
            self._flag = self._accumulator - first
        elif name == "dcr":
            decremented = first - 1 if first > -(2**31) else 2**31 - 1  # wraps around like a C int
            self._flag = self.parameters[operands[0].number] = decremented
        elif name == "mils":
            in_range = 0 <= first <= MAX_DELAY_MS
            self._accumulator = self._flag = 0 if in_range else errors.BAD_MILS_DELAY
            if in_range and first:
                self.time += first * 1e-3
                self._burst = 0
        elif name == "s":
            width = other_values[0]
            self._accumulator = self._flag = self._servo(now, first & 0xFFFFFFFF, width)
        elif name == "jmp" or (self._flag == 0) == (name == "jz"):
            self._position = first
