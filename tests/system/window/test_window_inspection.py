"""What the page shows of a fish and its computer: versions, disk, settings, log, and checks."""

import asyncio
import os
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import Daemon
from rigs.window_process import Browser, WindowProcess, running_window, wait_until_live

from fishd import __version__
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.protocol import Calibrations
from fishd.window import inspection

SERVICE = "from fishd.window import inspection; inspection._is_service = lambda link: True"
"""Lets a window take its fish for the service of systemd."""
JOURNAL = """#!/bin/sh
echo "$@" > {folder}/words
seq -f 'line %g' 1 500
"""


async def read(window: WindowProcess, part: str) -> Any:
    async with Browser(window.url) as browser:
        return await browser.get(f"/api/fish/fish/about/{part}")


async def test_the_versions_are_those_of_fish_page_and_system(window: WindowProcess) -> None:
    computer = await read(window, "computer")
    rows = {row["name"]: row["value"] for row in computer["rows"]}
    assert rows["fish"] == f"fishd {__version__}, robot simulated"
    assert rows["page"] == f"fishd-window {__version__}"
    assert {"Python", "system", "kernel", "computer"} <= rows.keys()
    assert computer["is_service"] is False


async def test_the_configuration_shows_what_differs_from_the_defaults(
    window: WindowProcess, daemon: Daemon
) -> None:
    keys = {key.pop("key"): key for key in (await read(window, "settings"))["keys"]}
    assert keys["control.address"] == {
        "value": daemon.endpoint, "default": None, "differs": True,
    }  # fmt: skip
    assert keys["tick"] == {"value": 0.05, "default": 0.05, "differs": False}
    assert keys["servo.driver"]["differs"] is False


async def test_a_silent_fish_leaves_the_computer_and_says_why_there_are_no_settings(
    own_daemon: Daemon, own_window: WindowProcess
) -> None:
    await wait_until_live(own_window)
    own_daemon.kill()
    async with Browser(own_window.url) as browser:
        refused = await browser.refusal("/api/fish/fish/about/settings")
        assert refused == (503, "no-daemon")
        assert (await browser.get("/api/fish/fish/about/computer"))["rows"]
        assert await browser.get("/api/fish/fish/about/camera") == []


def test_each_calibration_has_its_date_and_its_error_or_the_verb_that_makes_it() -> None:
    def list_rows(force: ForceCalibration, servo: ServoCalibration) -> list[tuple[str, str]]:
        calibrations = Calibrations(force, None, servo, None, 1.0)
        return [(row["date"], row["note"]) for row in inspection._list_calibrations(calibrations)]

    assert list_rows(ForceCalibration(), ServoCalibration()) == [
        ("", ""),
        ("", "forces are in volts: run fishctl calibrate force"),
        ("", "that of the configuration: run fishctl calibrate servo"),
    ]
    force = ForceCalibration(
        xx=2.0, loads=5, date="2026-01-02", tare_date="2026-01-03", covariance_x=(1e-4, 0.0, 1e-4)
    )
    tared, scale, servo = list_rows(force, ServoCalibration(date="2026-01-04"))
    assert (tared, servo) == (("2026-01-03", ""), ("2026-01-04", ""))
    assert scale == ("2026-01-02", "a thrust is known to ± 0.98%")
    assert list(inspection._list_calibrations(None)) == []


def test_the_bytes_of_an_hour_are_those_of_the_latest_recordings(tmp_path: Path) -> None:
    recordings = []
    for number in range(8):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(bytes(1000 * (number + 1)))
        recordings.append({"path": str(path), "state": "finished", "duration": 60.0})
    recordings += [
        {"path": str(path), "state": "recording", "duration": 90.0},
        {"path": str(path), "state": "finished", "duration": 1.0},
        {"path": str(tmp_path / "gone"), "state": "finished", "duration": 90.0},
        {"kind": "sweep", "path": str(path)},
    ]
    mean = (4000 + 5000 + 6000 + 7000 + 8000) / 5
    assert inspection._measure_rate(recordings) == (pytest.approx(60.0 * mean), 5)
    assert inspection._measure_rate([]) == (0.0, 0)


async def test_without_a_recording_the_bytes_of_an_hour_follow_the_tick(
    window: WindowProcess,
) -> None:
    disk = await read(window, "disk")
    assert disk["size"] > disk["free"] > 0
    assert (disk["hourly"], disk["recordings"]) == (280.0 * 3600 / 0.05, 0)


async def test_the_checks_are_those_of_doctor_and_run_once_for_all_pages_that_wait(
    daemon: Daemon, tmp_path: Path
) -> None:
    counted = f"""
from fishd.window import inspection
call = inspection.call_json
async def counting(words, runs):
    open({str(tmp_path / "calls")!r}, "a").write(words[0] + "\\n")
    return await call(words, runs)
inspection.call_json = counting
"""
    with running_window(tmp_path, changes=counted, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            path = "/api/fish/fish/doctor"
            answers = await asyncio.gather(*(browser.post(path) for _ in range(20)))
            assert all(answer == answers[0] for answer in answers)
            levels = {check["check"]: check["level"] for check in answers[0]}
            assert levels["daemon"] == "ok"
            assert (tmp_path / "calls").read_text() == "doctor\n"
            await browser.post(path)
            assert (tmp_path / "calls").read_text() == "doctor\n" * 2


async def test_a_disk_that_stalls_delays_neither_the_rest_nor_an_emergency_stop(
    daemon: Daemon, tmp_path: Path
) -> None:
    stalled = """
import time
from fishd.window import inspection
inspection.measure_disk = lambda folder: time.sleep(1e6)
inspection.ANSWER_TIMEOUT_S = 0.2
"""
    with running_window(tmp_path, changes=stalled, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            path = "/api/fish/fish/about/disk"
            refused = await asyncio.gather(*(browser.refusal(path) for _ in range(50)))
            assert set(refused) == {(503, "busy")}
            assert (await browser.get("/api/fish/fish/about/computer"))["rows"]
            assert (await browser.post("/api/fish/fish/estop"))["way"] == "control"


async def test_a_part_that_does_not_exist_is_named(window: WindowProcess) -> None:
    async with Browser(window.url) as browser:
        for part in ("none", "%2e%2e%2fdevices.json", "..%2f..%2fetc%2fpasswd"):
            refused = await browser.refusal(f"/api/fish/fish/about/{part}")
            assert refused == (404, "no-part")
        assert await browser.refusal("/api/fish/none/about/log") == (404, "no-fish")
        assert await browser.refusal("/api/fish/fish/doctor", {"yes": True}) == (
            400,
            "bad-arguments",
        )


async def test_a_fish_that_is_no_service_has_no_journal(window: WindowProcess) -> None:
    log = await read(window, "log")
    assert log["lines"] == []
    assert log["problem"] == "fishd is not the service of this computer; see its events"


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder whose programs are found first."""
    folder = tmp_path / "tools"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    return folder


def write_program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


async def test_the_log_of_a_service_is_the_end_of_its_journal_and_it_can_restart(
    daemon: Daemon, tmp_path: Path, tools: Path
) -> None:
    write_program(tools / "journalctl", JOURNAL.format(folder=tmp_path))
    with running_window(tmp_path, changes=SERVICE, fish=daemon.endpoint) as window:
        log = await read(window, "log")
        assert log == {"lines": [f"line {n}" for n in range(301, 501)], "problem": ""}
        assert "--unit=fishd.service --lines=200" in (tmp_path / "words").read_text()
        assert (await read(window, "computer"))["is_service"] is True


@pytest.mark.parametrize(
    ("journal", "problem"),
    [
        ("#!/bin/sh\necho 'No journal files were opened' >&2; exit 1", "No journal files were"),
        ("#!/bin/sh\n", "the journal has no line that the page may read; run: sudo journalctl"),
        (None, "journalctl: FileNotFoundError"),
    ],
)
async def test_a_journal_that_the_page_may_not_read_names_the_command_to_type(
    daemon: Daemon,
    tmp_path: Path,
    tools: Path,
    monkeypatch: pytest.MonkeyPatch,
    journal: str | None,
    problem: str,
) -> None:
    if journal is None:
        monkeypatch.setenv("PATH", str(tools))
    else:
        write_program(tools / "journalctl", journal)
    with running_window(tmp_path, changes=SERVICE, fish=daemon.endpoint) as window:
        log = await read(window, "log")
    assert log["lines"] == []
    assert problem in log["problem"]
    assert log["problem"].endswith("run: sudo journalctl --unit=fishd.service --lines=200")
