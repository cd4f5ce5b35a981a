"""Runs pigpio scripts, the small programs that live inside pigpiod.

Scripts do not run by themselves: whoever wants to know something lets them catch up first. Their
semantics are pigpiod 79's, including that `nop` never goes on to the next instruction.
"""

import math
from collections.abc import Callable
from enum import IntEnum

from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.calculator import Calculator, StackError
from fishd.emulation.pigpiod.parser import Instruction

INSTRUCTION_TIME = 1e-6
"""Time that an instruction takes [s]; pigpiod on a Pi 4 is of that order."""
INITIALISING_TIME = 1e-3
"""Time from storing a script until it can be run [s]."""
BURST = 5000
"""Most instructions without a pause; of a script that wants more, the rest of the time is lost."""
PAUSE = 1e-3
"""A delay this long ends a burst [s]."""
DELAYS = {
    "mils": (1e-3, 60_000, errors.BAD_MILS_DELAY),
    "mics": (1e-6, 1_000_000, errors.BAD_MICS_DELAY),
}
"""Instruction → its unit [s], the longest delay in units, and the error of a longer one."""

Execute = Callable[[float, int, int, int, bytes], int]
"""Carries out a pigpio command: time [s], number, p1, p2, extension → result."""


class State(IntEnum):
    """What `script_status` says; a script in a delay is running."""

    INITIALISING = 0
    HALTED = 1
    RUNNING = 2
    WAITING = 3
    FAILED = 4


class Script:
    """One stored script: its program, its registers and how far it has come.

    Times are seconds of the daemon's clock and must not go back from call to call.
    """

    def __init__(self, program: tuple[Instruction, ...], execute: Execute, time: float) -> None:
        self._program = program
        self._execute = execute
        self._ready = time + INITIALISING_TIME
        self._state = State.HALTED
        self._wanted = False
        self._calculator = Calculator()
        self._burst = 0
        self._last_pause: tuple[float, ...] = (0.0,)
        self.time = math.inf
        """When its next instruction is due [s]; infinity while nothing is."""
        self.waits_for = self.waits_for_events = 0
        """The levels and events that it waits for, as bits."""
        self.waits_since = -math.inf

    @property
    def parameters(self) -> tuple[int, ...]:
        """The values of p0 to p9."""
        return self._calculator.parameters

    def state(self, time: float) -> State:
        """What it is doing at a time [s] up to which it has run."""
        return State.INITIALISING if time < self._ready else self._state

    def update(self, parameters: tuple[int, ...]) -> int:
        """Overwrite the first parameters, whether it runs or not."""
        self._calculator.parameters = parameters
        return 0

    def start(self, time: float, parameters: tuple[int, ...]) -> int:
        """Run from the top; one that is running just gets its parameters.

        Raises `PigpioError` SCRIPT_NOT_READY while it is initialising.
        """
        if self.state(time) is State.INITIALISING:
            raise errors.PigpioError(errors.SCRIPT_NOT_READY)
        self._calculator.parameters = parameters
        self._wanted = True
        if self._state in (State.HALTED, State.FAILED):
            self._calculator.restart()
            self._burst = 0
            self._state, self.time = State.RUNNING, time
        return 0

    def stop(self, time: float) -> int:
        """Ask it to halt: at the end of a delay, at once if it waits for a level or an event."""
        self._wanted = False
        if self._state is State.WAITING:
            self.wake(time, 0)
        return 0

    def wake(self, time: float, bits: int) -> None:
        """End its waiting at a time [s]; `bits`: the levels or events that changed."""
        self._calculator.conclude(bits)
        self.waits_for = self.waits_for_events = 0
        self._state, self.time = State.RUNNING, time

    def hold(self, until: float) -> None:
        """Let nothing of it happen before a time [s]; for a daemon that stood still."""
        self.time = max(self.time, until)

    def run(self, until: float) -> None:
        """Carry out what is due at or before a time [s], and at least one instruction."""
        self._step(until)
        while self.time <= until:
            if self._burst >= BURST:
                self._burst = 0
                self.time = math.nextafter(until, math.inf)
                return
            self._step(until)

    def _step(self, until: float) -> None:
        position = self._calculator.position
        if not self._wanted or position >= len(self._program):
            self._halt(State.HALTED)
            return
        instruction = self._program[position]
        name = instruction.name
        now = self.time
        self.time = now + INSTRUCTION_TIME
        self._burst += 1
        if instruction.command is not None:
            self._command(now, instruction.command, instruction)
        elif name in DELAYS:
            self._delay(now, instruction, until)
        elif name in ("wait", "evtwt"):
            self._wait(instruction)
        elif name == "halt":
            self._halt(State.HALTED)
        elif name != "nop":
            try:
                self._calculator.calculate(name, *instruction.operands)
            except StackError:
                self._halt(State.FAILED)

    def _halt(self, state: State) -> None:
        self._state, self.time = state, math.inf

    def _command(self, now: float, number: int, instruction: Instruction) -> None:
        calculator = self._calculator
        values = [calculator.value(operand) & 0xFFFFFFFF for operand in instruction.operands]
        first, second, third = [*values, 0, 0, 0][:3]
        calculator.conclude(self._execute(now, number, first, second, third.to_bytes(4, "little")))
        # Its result may differ each time, so that the rounds of a loop are not all alike.
        calculator.changes += 1
        calculator.position += 1

    def _delay(self, now: float, instruction: Instruction, until: float) -> None:
        unit, longest, error = DELAYS[instruction.name]
        amount = self._calculator.value(instruction.operands[0])
        result = 0 if 0 <= amount <= longest else error
        if result == 0:
            self.time += amount * unit
            if amount * unit >= PAUSE:
                self._burst = 0
                self._skip_idle_rounds(now, until)
        self._calculator.conclude(result)
        self._calculator.position += 1

    def _skip_idle_rounds(self, now: float, until: float) -> None:
        """Save the work of a loop that has changed nothing since it paused here the last time."""
        machine = self._calculator
        state = (machine.position, machine.accumulator, machine.flag, machine.changes)
        skipped = 0.0
        if state == self._last_pause[1:]:
            period = now - self._last_pause[0]
            skipped = max(0, math.floor((until - now) / period)) * period
            self.time += skipped
        self._last_pause = (now + skipped, *state)

    def _wait(self, instruction: Instruction) -> None:
        bits = self._calculator.value(instruction.operands[0]) & 0xFFFFFFFF
        if instruction.name == "wait":
            self.waits_for = bits
        else:
            self.waits_for_events = bits
        self._calculator.position += 1
        self.waits_since = self.time
        self._state, self.time = State.WAITING, math.inf
