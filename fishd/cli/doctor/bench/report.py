"""Report of `fishctl doctor --bench`: its data, and its page."""

from msgspec import Struct

FORMAT = "fishd-bench 1"
"""Name and version of the data."""


class Finding(Struct, frozen=True):
    """Line of the report."""

    check: str
    level: str
    message: str
    remedy: str


class Board(Struct, frozen=True):
    """The computer and its software."""

    model: str
    architecture: str
    system: str
    kernel: str
    preempt_rt: bool
    governor: str
    """Governor of the processor; empty if unknown."""
    throttled: str
    """Flags of the firmware as a hexadecimal number; empty if unknown."""
    temperature: float | None
    """Temperature of the processor after the measurement [°C]."""
    python: str
    fishd: str
    packages: dict[str, str]
    """Versions of the packages of the drivers, and of the libraries of each tick."""
    drivers: dict[str, str]
    """Driver of each part."""


class Pulses(Struct, frozen=True):
    """Servo pulses on the looped pin during one part of the measurement."""

    count: int
    missing: int
    """Number of pulses that are missing between two others."""
    width: float
    """Mean width [µs]."""
    error: float
    """Mean difference to the nearest width that fishd sent [µs]."""
    deviation_p99: float
    """99 % of the pulses differ less from the nearest width that fishd sent [µs]."""
    deviation_max: float
    """[µs]"""
    period: float
    """Mean period [ms]."""
    jitter_p99: float
    """99 % of the periods differ less from the mean period [µs]."""
    jitter_max: float
    """[µs]"""


class Ending(Struct, frozen=True):
    """End of the pulses after fishd was ended; times since then [s]."""

    neutral: float | None
    """Start of the first pulse of those at neutral that come last; None: none was at neutral."""
    off: float | None
    """End of the last pulse; None: the pulses go on."""


class Filter(Struct, frozen=True):
    """ADC against the pulses, through the filter."""

    high_level: float
    """Voltage of the pin at level 1, as the ADC sees it: the slope of voltage over duty [V]."""
    high_level_ci95: float
    """Half-width of the 95 % confidence interval of the slope [V]."""
    offset: float
    """Voltage at duty 0, from the same line [V]."""
    residual: float
    """Largest distance of a mean voltage from the line [V]."""
    time_constant: tuple[float, float]
    """Bounds of the time of 63 % of the voltage's change, ± a period of the pulses [s]."""
    duties: list[float]
    volts: list[float]
    """Mean voltage at each duty [V]."""


class Bus(Struct, frozen=True):
    """I2C bus and the oscillator of the ADC."""

    bit_rate: float
    """Bit rate from transfers of different lengths [bit/s]."""
    configured: float | None
    """Bit rate in the device tree [bit/s]; None if unknown."""
    overhead: float
    """Rest of a transfer: kernel, library and Python [s]."""
    conversion: tuple[float, float] | None = None
    """Bounds of the time of a conversion, as a multiple of its nominal time."""


class Lateness(Struct, frozen=True):
    """Lateness of wake-ups in the same seconds [µs]."""

    seconds: float
    tick: float
    """Time between two wake-ups [s]."""
    priority: int
    """SCHED_FIFO priority; 0: the normal scheduler."""
    fishd: tuple[float, float, float]
    """Median, 99 % and maximum."""
    cyclictest: tuple[float, float, float] | None
    """None if it is not installed or not permitted."""


class BenchReport(Struct):
    """The whole report; a part that was not measured is None, and a finding says why."""

    date: str
    board: Board
    format: str = FORMAT
    countdown: float | None = None
    """Time after which the driver promises neutral without fishd [s]; None if it has no such."""
    held: Pulses | None = None
    swimming: Pulses | None = None
    stopped: Ending | None = None
    """After a SIGTERM, from the signal on."""
    killed: Ending | None = None
    """After a SIGKILL, from the end of the process on."""
    filter: Filter | None = None
    bus: Bus | None = None
    lateness: Lateness | None = None
    findings: list[Finding] = []


def page(report: BenchReport) -> str:
    """Return the report as a page in Markdown."""
    board = report.board
    lines = [f"# {board.model or 'Unknown board'}, {report.date}", ""]
    real_time = "PREEMPT_RT" if board.preempt_rt else "no PREEMPT_RT"
    lines += [
        f"fishd {board.fishd}, Python {board.python}, {board.system}, kernel {board.kernel}",
        f"({real_time}), {board.architecture}.",
        "",
    ]
    lines += ["| check | result | |", "| --- | --- | --- |"]
    for finding in report.findings:
        remedy = f" ({finding.remedy})" if finding.remedy else ""
        lines.append(f"| {finding.check} | {finding.level} | {finding.message}{remedy} |")
    rows = [
        *(("driver of the " + section, name) for section, name in board.drivers.items()),
        ("governor", board.governor or "unknown"),
        ("throttled", board.throttled or "unknown"),
        ("temperature", "unknown" if board.temperature is None else f"{board.temperature:.1f} °C"),
        *board.packages.items(),
    ]
    lines += ["", "| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in rows)]
    return "\n".join([*lines, ""])
