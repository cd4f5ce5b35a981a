"""Writer of the table of measured boards in docs/, from the reports of `fishctl doctor --bench`.

python tools/boards.py --write     after a report was copied to docs/boards/
python tools/boards.py --check     exits with 1 when the table is out of date
"""

import sys
from collections.abc import Iterable
from pathlib import Path

import msgspec

from common.report import DOCS, table, write_reference
from fishd.cli.doctor.bench.report import FORMAT, BenchReport, Ending, Pulses

EXPECTED = (
    *("Raspberry Pi 3 Model B Plus", "Raspberry Pi Zero 2 W", "Raspberry Pi 4 Model B"),
    "Raspberry Pi 5 Model B",
)
"""Boards that have a row without a report, too."""
HEAD = (
    "board | system | servo driver | pulses: 99 % within [µs] | "
    "after SIGKILL: neutral, off [s] | I2C measured / configured [kbit/s] | ADC: level 1 [V] | "
    "late, median / 99 % [µs] | cyclictest | FAIL | date"
)


def read(folder: Path) -> list[BenchReport]:
    """Return the reports in a folder, by board and date; raise SystemExit for a damaged one."""
    reports = []
    for path in sorted(folder.glob("*.json")):
        try:
            report = msgspec.json.decode(path.read_bytes(), type=BenchReport)
        except msgspec.MsgspecError as error:
            raise SystemExit(f"{path}: not a report of fishctl doctor --bench: {error}") from None
        if report.format != FORMAT:
            raise SystemExit(f"{path}: format '{report.format}': '{FORMAT}' is needed")
        reports.append(report)
    return sorted(reports, key=lambda report: (report.board.model, report.date))


def row(report: BenchReport) -> list[str]:
    """Return the cells of one report; a part that was not measured has a dash."""
    board, bus, late = report.board, report.bus, report.lateness
    kernel = f"{board.system}, {board.kernel}" + (", PREEMPT_RT" if board.preempt_rt else "")
    rates = "–"
    if bus:
        configured = f"{bus.configured / 1e3:.0f}" if bus.configured else "?"
        rates = f"{bus.bit_rate / 1e3:.0f} / {configured}"
    level = report.filter
    return [
        board.model or "unknown",
        f"{kernel}; Python {board.python}, fishd {board.fishd}",
        board.drivers.get("servo", "–"),
        _pulses(report.swimming or report.held),
        _ending(report.killed),
        rates,
        f"{level.high_level:.3f} ± {level.high_level_ci95:.3f}" if level else "–",
        f"{late.fishd[0]:.0f} / {late.fishd[1]:.0f}" if late else "–",
        f"{late.cyclictest[0]:.0f} / {late.cyclictest[1]:.0f}" if late and late.cyclictest else "–",
        ", ".join(item.check for item in report.findings if item.level == "FAIL") or "none",
        report.date,
    ]


def _pulses(pulses: Pulses | None) -> str:
    return f"{pulses.deviation_p99:.0f}" if pulses else "–"


def _ending(ending: Ending | None) -> str:
    if ending is None:
        return "–"
    times = (ending.neutral, ending.off)
    return ", ".join("never" if time is None else f"{time:.2f}" for time in times)


def reference(reports: Iterable[BenchReport]) -> str:
    """Return the table: a row for each report, and for each expected board without one."""
    rows = [row(report) for report in reports]
    measured = {cells[0] for cells in rows}
    rest = [""] * (HEAD.count(" | ") - 1)
    rows += [
        [name, "untested", *rest]
        for name in EXPECTED
        if not any(model.startswith(name) for model in measured)
    ]
    return table(HEAD, rows)


if __name__ == "__main__":
    text = reference(read(DOCS / "boards"))
    sys.exit(write_reference("boards", [("how-to/bench.md", "boards", text)]))
