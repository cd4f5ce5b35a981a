"""The scripts of the emulated pigpiod: small programs that run inside of it.

It has the instructions of fishd's countdown and no others. Scripts do not run by themselves:
whoever wants to know something lets them catch up with the clock first.
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

PARAMETERS = 10
INSTRUCTION_TIME = 1e-6
"""Time that an instruction takes [s]; pigpiod on a Pi 4 is of that order."""
INITIALISING_TIME = 1e-3
"""Time from storing a script until it can be run [s]."""
LONGEST_DELAY = 60_000
"""Of the command and the instruction `mils` [ms]."""
BURST = 5000
"""Most instructions without a pause; of a script that wants more, the rest of the time is lost."""

# Operands by instruction: n a number, v a number or a parameter, p a parameter.
_OPERANDS = {"tag": "n", "jmp": "n", "jz": "n", "jnz": "n"}
_OPERANDS |= {"mils": "v", "lda": "v", "cmp": "v", "dcr": "p", "s": "vv"}
_WORDS = {"n": re.compile(r"()(\d+)"), "v": re.compile(r"(p?)(\d+)"), "p": re.compile(r"(p)(\d+)")}


class State(IntEnum):
    """What `script_status` says; a script in a delay is running."""

    INITIALISING = 0
    HALTED = 1
    RUNNING = 2


class Operand(NamedTuple):
    """A number, or that of a parameter."""

    parameter: bool
    number: int


class Instruction(NamedTuple):
    """One step of a script; jumps have the place they go to."""

    name: str
    operands: tuple[Operand, ...]


def parse(text: str) -> tuple[Instruction, ...]:
    """The instructions of a script.

    Raises `PigpioError`: BAD_SCRIPT_CMD for an instruction that is not emulated or a bad operand,
    DUP_TAG, and BAD_TAG for a jump to nowhere.
    """
    words = text.lower().split()
    program: list[Instruction] = []
    places: dict[int, int] = {}
    while words:
        name = words.pop(0)
        if name not in _OPERANDS:
            known = ", ".join(_OPERANDS)
            log.warning(
                "emulated pigpiod: script refused: '%s' is none of the instructions that are "
                "emulated: %s",
                *(name, known),
            )
            raise PigpioError(errors.BAD_SCRIPT_CMD)
        operands = tuple(_operand(words.pop(0) if words else "", k) for k in _OPERANDS[name])
        if name == "tag":
            check(operands[0].number not in places, errors.DUP_TAG)
            places[operands[0].number] = len(program)
        else:
            program.append(Instruction(name, operands))
    for position, (name, operands) in enumerate(program):
        if name.startswith("j"):
            check(operands[0].number in places, errors.BAD_TAG)
            place = Operand(False, places[operands[0].number])
            program[position] = Instruction(name, (place,))
    return tuple(program)


def _operand(word: str, kind: str) -> Operand:
    match = _WORDS[kind].fullmatch(word)
    if not match or int(match[2]) >= (PARAMETERS if match[1] else 2**31):
        raise PigpioError(errors.BAD_SCRIPT_CMD)
    return Operand(bool(match[1]), int(match[2]))


class Script:
    """One stored script: its program, its parameters and how far it has come.

    Times are seconds of the daemon's clock and must not go back from call to call.
    """

    def __init__(self, text: str, servo: Callable[[float, int, int], int], time: float) -> None:
        """`servo`: carries out the instruction `s`: time [s], GPIO, width [µs]; gives its result.

        Raises `PigpioError` as `parse` does.
        """
        self._program = parse(text)
        self._servo = servo
        self._ready = time + INITIALISING_TIME
        self._wanted = False
        self._accumulator = self._flag = self._position = self._burst = 0
        self.parameters = [0] * PARAMETERS
        self.time = math.inf
        """When its next instruction is due [s]; infinity while it is halted."""

    def state(self, time: float) -> State:
        """What it is doing at a time [s] up to which it has run."""
        if time < self._ready:
            return State.INITIALISING
        return State.HALTED if self.time == math.inf else State.RUNNING

    def update(self, parameters: tuple[int, ...]) -> int:
        """Overwrite the first parameters, whether it runs or not."""
        self.parameters[: len(parameters)] = parameters
        return 0

    def start(self, time: float, parameters: tuple[int, ...]) -> int:
        """Run from the top; one that is running just gets its parameters.

        Raises `PigpioError` SCRIPT_NOT_READY while it is initialising.
        """
        state = self.state(time)
        check(state is not State.INITIALISING, errors.SCRIPT_NOT_READY)
        self.update(parameters)
        self._wanted = True
        if state is State.HALTED:
            self._accumulator = self._flag = self._position = self._burst = 0
            self.time = time
        return 0

    def stop(self) -> int:
        """Ask it to halt, which it does at the end of a delay."""
        self._wanted = False
        return 0

    def run(self, until: float) -> None:
        """Carry out what is due at or before a time [s]."""
        while self.time <= until:
            if self._burst >= BURST:
                self._burst = 0
                self.time = math.nextafter(until, math.inf)
            elif self._wanted and self._position < len(self._program):
                self._step()
            else:
                self.time = math.inf

    def _step(self) -> None:
        name, operands = self._program[self._position]
        first, *more = (self.parameters[n] if parameter else n for parameter, n in operands)
        now = self.time
        self.time += INSTRUCTION_TIME
        self._burst += 1
        self._position += 1
        if name == "lda":
            self._accumulator = first
        elif name == "cmp":
            self._flag = self._accumulator - first
        elif name == "dcr":
            left = first - 1 if first > -(2**31) else 2**31 - 1  # as a C int does
            self._flag = self.parameters[operands[0].number] = left
        elif name == "mils":
            in_range = 0 <= first <= LONGEST_DELAY
            self._accumulator = self._flag = 0 if in_range else errors.BAD_MILS_DELAY
            if in_range and first:
                self.time += first * 1e-3
                self._burst = 0
        elif name == "s":
            width = more[0]
            self._accumulator = self._flag = self._servo(now, first & 0xFFFFFFFF, width)
        elif name == "jmp" or (self._flag == 0) == (name == "jz"):
            self._position = first
