"""`fishctl doctor --bench` on the virtual Pi, with its wires as drawn and with mistakes."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import FISHCTL, Process, fishctl, one_line, running, sets, wait_until
from rigs.virtual_pi_process import Pi, virtual_pi

from fishd.cli.doctor.bench import analog

WIRED = ("virtual_pi.loop_gpio=23", "virtual_pi.filter_time=0.1")


@pytest.fixture(autouse=True)
def _brief_averages(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the measurement of the filter where its accuracy is not tested."""
    if not request.node.get_closest_marker("realtime"):
        monkeypatch.setattr(analog, "SETTLING_S", 0.6)
        monkeypatch.setattr(analog, "AVERAGING_S", 0.3)


def bench(pi: Pi, *options: str) -> tuple[int, dict[str, tuple[str, str]], dict[str, Any]]:
    """Return the exit status, level and message of each line, and the report."""
    own = sets(f"control.address=ipc://{pi.folder}/control")
    output = pi.folder / "reports"
    verb = ("doctor", "--bench", "--yes", "--for", "1", "--to", str(output))
    done = fishctl(*verb, *pi.settings, *own, *options)
    assert done.stderr == ""
    (data,), (page,) = output.glob("*.json"), output.glob("*.md")
    report = json.loads(data.read_text())
    findings = {f["check"]: (f["level"], f["message"]) for f in report["findings"]}
    for level, message in findings.values():
        assert message in page.read_text()
        assert f"{level:<8}" in done.stdout
    return done.returncode, findings, report


@pytest.mark.realtime
def test_a_wired_board_is_measured_from_its_bus_to_the_end_of_its_pulses(tmp_path: Path) -> None:
    with virtual_pi(tmp_path, *WIRED) as pi:
        status, findings, report = bench(pi)
    print(findings)
    assert {level for level, _ in findings.values()} == {"ok"}
    assert status == 0
    assert report["format"] == "fishd-bench 1"
    assert report["board"]["model"] == "virtual Pi"
    assert report["filter"]["high_level"] == pytest.approx(3.3, abs=0.1)
    low, high = report["bus"]["conversion"]
    assert high > 0.9
    assert low < 1.12
    assert report["held"]["width"] == pytest.approx(1500, abs=1)
    assert report["held"]["jitter_max"] <= 1.5
    assert report["swimming"]["deviation_max"] <= 5
    assert report["swimming"]["missing"] == 0
    assert report["countdown"] == 2.0
    assert report["killed"]["neutral"] == pytest.approx(2.0, abs=0.2)
    assert report["killed"]["off"] - report["killed"]["neutral"] == pytest.approx(0.5, abs=0.1)
    assert report["stopped"]["off"] is not None
    assert report["lateness"]["tick"] == 0.05


def test_a_wire_at_another_pin_and_an_adc_that_reads_high_are_named(tmp_path: Path) -> None:
    wires = ("virtual_pi.loop_gpio=24", "virtual_pi.filter_time=0.1", "virtual_pi.adc_gain=1.2")
    with virtual_pi(tmp_path, *wires) as pi:
        status, findings, report = bench(pi)
    assert status == 1
    assert findings["pulses"] == (
        "warning",
        "the wire leads to GPIO 24 instead of GPIO 23: move it, or give --loop-gpio 24",
    )
    level, message = findings["adc and pulses"]
    assert level == "FAIL"
    assert report["filter"]["high_level"] == pytest.approx(1.2 * 3.3, abs=0.1)
    assert message.endswith("%")
    assert report["killed"] is None


def test_both_missing_wires_are_said_in_a_line_each(tmp_path: Path) -> None:
    with virtual_pi(tmp_path) as pi:
        status, findings, report = bench(pi)
    assert status == 1
    assert "no pulses arrive at GPIO 23: no wire leads to it" in findings["pulses"][1]
    assert "no wire leads to it" in findings["adc and pulses"][1]
    assert (report["held"], report["filter"]) == (None, None)


def test_pulses_that_jitter_and_a_bare_wire_fail(tmp_path: Path) -> None:
    with virtual_pi(tmp_path, "virtual_pi.loop_gpio=23", "virtual_pi.filter_time=0") as pi:
        pi.control("inject", "pulse-jitter")
        status, findings, report = bench(pi)
    assert status == 1
    assert findings["pulses held"][0] == "FAIL"
    assert 50.0 < report["held"]["deviation_max"] <= 101.0
    assert "without the resistor and the capacitor" in findings["adc and pulses"][1]


def test_without_pigpiod_and_sensor_each_part_says_so(tmp_path: Path) -> None:
    with virtual_pi(tmp_path, *WIRED) as pi:
        pi.control("inject", "pigpiod-gone")
        pi.control("inject", "unplugged")
        status, findings, _ = bench(pi)
    assert status == 0
    assert findings["adc and bus"][1].startswith("not measured: nothing answers at 0x48")
    assert findings["pulses"][1].startswith("not measured: pigpiod at 127.0.0.1")


def test_the_drawing_has_the_pins_and_no_answer_means_no(tmp_path: Path) -> None:
    own = sets("robot=pi", f"control.address=ipc://{tmp_path}/control")
    done = fishctl("doctor", "--bench", *own)
    assert done.returncode == 1
    assert "pin 12 (GPIO 18, the servo's) ---+---" in done.stderr
    assert "pin 16 (GPIO 23)" in done.stderr
    assert "10 kΩ" in done.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "robot: simulated has no board to measure"),
        ([*sets("robot=pi"), "--loop-gpio", "18"], "--loop-gpio 18: servo.gpio uses this pin"),
        ([*sets("robot=pi"), "--loop-gpio", "2"], "--loop-gpio 2: a bus uses this pin"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_line(
    tmp_path: Path, options: list[str], words: str
) -> None:
    own = sets(f"control.address=ipc://{tmp_path}/control")
    assert words in one_line(fishctl("doctor", "--bench", *own, *options))


def test_a_folder_that_cannot_be_written_is_refused_before_the_measurement(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    own = sets("robot=pi", f"control.address=ipc://{tmp_path}/control")
    refused = fishctl("doctor", "--bench", "--yes", "--to", str(tmp_path / "file" / "sub"), *own)
    assert "cannot be written: Not a directory" in one_line(refused)


def test_a_bench_that_is_ended_ends_its_fishd(tmp_path: Path) -> None:
    with virtual_pi(tmp_path, "virtual_pi.loop_gpio=23") as pi:
        own = sets(f"control.address=ipc://{tmp_path}/control")
        verb = ("doctor", "--bench", "--yes", "--for", "60", "--to", str(tmp_path / "reports"))
        environment = os.environ | {"TMPDIR": str(tmp_path)}
        with Process(FISHCTL, *verb, *pi.settings, *own, env=environment) as process:
            wait_until(lambda: any(tmp_path.glob("fishd-bench-*/control")))
            status, _, errors = process.end()
        assert status == 130  # as after Ctrl-C
        assert errors.strip() == "fishctl: interrupted"
        assert not any(tmp_path.glob("fishd-bench-*"))
        pi.wait_until_released()


def test_a_running_fishd_is_not_disturbed(tmp_path: Path) -> None:
    with virtual_pi(tmp_path) as pi, running(tmp_path, *pi.settings) as daemon:
        own = sets(f"control.address={daemon.endpoint}")
        refused = one_line(fishctl("doctor", "--bench", "--yes", *pi.settings, *own))
    assert "fishd is running" in refused
    assert "stop it first" in refused
