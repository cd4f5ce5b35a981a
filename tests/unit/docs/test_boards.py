"""The table of measured boards, written from reports."""

import json
from pathlib import Path

import msgspec
import pytest

import boards
from common.report import DOCS, between
from fishd.cli.doctor.bench.report import BenchReport, Board, Ending, Filter, Finding, Lateness

BOARD = Board(
    "Raspberry Pi 4 Model B Rev 1.5", "aarch64, 64bit", "Debian GNU/Linux 12 (bookworm)", "6.6.31",
    True, "performance", "0x0", 50.0, "3.11.2", "0.1.0", {}, {"servo": "pigpio"},
)  # fmt: skip
REPORT = BenchReport(
    "2026-11-27",
    BOARD,
    killed=Ending(0.21, None),
    filter=Filter(3.28, 0.01, 0.001, 0.001, (0.1, 0.1), [0.0], [0.0]),
    lateness=Lateness(10.0, 0.05, 50, (20.0, 60.0, 90.0), (15.0, 40.0, 70.0)),
    findings=[Finding("kill", "FAIL", "the pulses go on", "report this")],
)


def test_the_page_has_a_row_for_each_report_in_the_folder() -> None:
    text = boards.reference(boards.read(DOCS / "boards"))
    assert between(DOCS / "how-to" / "bench.md", "boards") == text


def test_a_report_fills_the_row_of_its_board_and_the_others_are_untested(tmp_path: Path) -> None:
    (tmp_path / "pi4.json").write_bytes(msgspec.json.encode(REPORT))
    rows = boards.reference(boards.read(tmp_path)).splitlines()[2:]
    assert [row.split(" | ")[1] for row in rows][1:] == ["untested"] * 3
    assert rows[0].startswith("| Raspberry Pi 4 Model B Rev 1.5 | Debian GNU/Linux 12 (bookworm), ")
    for cell in ("PREEMPT_RT", "| pigpio |", "0.21, never", "3.280 ± 0.010", "20 / 60", "15 / 40"):
        assert cell in rows[0]
    assert rows[0].endswith("| kill | 2026-11-27 |")
    assert len({row.count("|") for row in rows}) == 1


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("{}", "not a report of fishctl doctor --bench"),
        (json.dumps(msgspec.to_builtins(REPORT) | {"format": "fishd-bench 9"}), "'fishd-bench 9'"),
    ],
)
def test_another_file_is_refused_in_one_line(tmp_path: Path, data: str, words: str) -> None:
    (tmp_path / "x.json").write_text(data)
    with pytest.raises(SystemExit, match=words):
        boards.read(tmp_path)
