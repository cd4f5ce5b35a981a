"""`fishctl watch`, as real processes under pipes and terminals, and its screen by itself."""

import fcntl
import io
import json
import math
import os
import pty
import re
import signal
import struct
import subprocess
import termios
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.screen import Screen
from rigs.drawing_interrupted import ENTER_SCREEN, LEAVE_SCREEN, signal_as_drawing_begins
from rigs.processes import FISHCTL, PATIENCE, Daemon, running, wait_until

from fishd.cli.status import _reading_rows
from fishd.cli.watch_screen import View
from fishd.client import Fish
from fishd.core.console import status_line
from fishd.core.signals import (
    LeaseHolder,
    Percentiles,
    ReadingState,
    Reason,
    Status,
    Tick,
    Timing,
)

HIDE_CURSOR, SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"
COLOUR = re.compile(r"\x1b\[(?:\d+;)*[34]\d(?:;\d+)*m")
BRAILLE = re.compile("[\u2801-\u28ff]")


@pytest.fixture
def daemon(shared_daemon: Daemon) -> Daemon:
    """The fishd, swimming, reset to its state after the start."""
    with Fish(shared_daemon.at_rest().endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("swing")
        wait_until(lambda: fish.status().phi_c != 0.0)
    return shared_daemon


class Terminal:
    """Terminal in which `fishctl watch` runs, with all of its output."""

    def __init__(self, daemon: Daemon, *options: str, **env: str) -> None:
        self._master, self._slave = pty.openpty()
        self.resize(80, 24)
        self._settings = termios.tcgetattr(self._slave)
        plain = {name: os.environ[name] for name in os.environ if name != "NO_COLOR"}
        self._process = subprocess.Popen(
            [FISHCTL, "--endpoint", daemon.endpoint, "watch", *options],
            stdin=self._slave,
            stdout=self._slave,
            stderr=self._slave,
            env=plain | {"TERM": "xterm-256color"} | env,
            start_new_session=True,
        )
        os.set_blocking(self._master, False)
        self.text = ""

    def resize(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self._slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))

    def wait_for(self, pattern: str, meanwhile: Callable[[], object] = lambda: None) -> None:
        """Read until `pattern` appears in new output; meanwhile: called repeatedly."""
        deadline = time.monotonic() + PATIENCE
        start = len(self.text)
        while not re.search(pattern, self.text[start:]):
            assert time.monotonic() < deadline, self.text
            meanwhile()
            self._read()
            time.sleep(0.02)

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def finish(self) -> int:
        """Wait for the end; return the exit status."""
        deadline = time.monotonic() + PATIENCE
        while self._process.poll() is None:
            assert time.monotonic() < deadline, self.text
            self._read()
            time.sleep(0.02)
        self._read()
        assert termios.tcgetattr(self._slave) == self._settings
        os.close(self._master)
        os.close(self._slave)
        return self._process.returncode

    def _read(self) -> None:
        try:
            while chunk := os.read(self._master, 65536):
                self.text += chunk.decode(errors="replace")
        except BlockingIOError:
            return

    @property
    def restored(self) -> bool:
        """Whether the previous screen is restored, with its cursor."""
        return self.text.rfind(LEAVE_SCREEN) > self.text.rfind(ENTER_SCREEN) and self.text.rfind(
            SHOW_CURSOR
        ) > self.text.rfind(HIDE_CURSOR)


def test_json_streams_every_tick_as_one_line(daemon: Daemon) -> None:
    ended = daemon.fishctl("watch", "--json", "--seconds", "3")
    assert (ended.returncode, ended.stderr) == (0, "")
    ticks = [json.loads(line) for line in ended.stdout.splitlines()]
    first = ticks[0]["seq"]
    assert len(ticks) > 3
    assert [tick["seq"] for tick in ticks] == list(range(first, first + len(ticks)))
    assert {tick["controller"] for tick in ticks} == {"swing"}
    assert ticks[0]["phi_c"] in (-0.42, 0.42)


def test_json_lines_are_not_held_back_and_ctrl_c_is_a_clean_end(daemon: Daemon) -> None:
    with subprocess.Popen(
        [FISHCTL, "--endpoint", daemon.endpoint, "watch", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert json.loads(process.stdout.readline())["mode"] == "running"
        process.send_signal(signal.SIGINT)
        process.stdout.read()
        assert process.stderr.read() == ""
        assert process.wait(PATIENCE) == 0


def test_without_a_terminal_it_prints_a_plain_line_every_second(daemon: Daemon) -> None:
    ended = daemon.fishctl("watch", "--seconds", "2.5")
    assert (ended.returncode, ended.stderr) == (0, "")
    lines = ended.stdout.splitlines()
    assert 1 <= len(lines) <= 3
    pattern = r"\d\d:\d\d:\d\d  \S+  running swing .* ticks"
    assert all(re.match(pattern, line) for line in lines)
    assert re.search(r" ticks  top_speed \S+  reversal_speed \S+  since_reversal \S+ s$", lines[-1])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_draws_until_a_signal_and_restores_the_terminal(daemon: Daemon, number: int) -> None:
    terminal = Terminal(daemon)
    terminal.wait_for("RUNNING")
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        # Events have a separate subscription, which may begin after the first tick is drawn.
        terminal.wait_for("mark: a weight on it", meanwhile=lambda: fish.mark("a weight on it"))
        fish.estop("the net")
    terminal.wait_for("estop: the net")
    terminal.signal(number)
    assert terminal.finish() == 0
    assert terminal.restored
    assert terminal.text.endswith((LEAVE_SCREEN, SHOW_CURSOR))
    assert COLOUR.search(terminal.text)
    assert BRAILLE.search(terminal.text)
    figures = ("swing", "thrust", "tail beat", "late", "compute", "skipped", "lost")
    for word in (*figures, "fx mN", "fy mN", "phi_c rad"):
        assert word in terminal.text
    assert "Traceback" not in terminal.text


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_at_the_moment_when_it_takes_the_screen_gives_it_back(
    daemon: Daemon, tmp_path: Path, name: str
) -> None:
    terminal = Terminal(daemon, **signal_as_drawing_begins(tmp_path, name))
    assert terminal.finish() == 0
    assert ENTER_SCREEN in terminal.text
    assert terminal.restored
    assert "Traceback" not in terminal.text


def test_the_death_of_the_daemon_is_one_line_on_a_restored_terminal(tmp_path: Path) -> None:
    with running(tmp_path, "--set", "start.controller=swing") as daemon:
        terminal = Terminal(daemon)
        terminal.wait_for("RUNNING")
        daemon.process.kill()
    assert terminal.finish() == 1
    assert terminal.restored
    after = terminal.text.rpartition(LEAVE_SCREEN)[2].replace(SHOW_CURSOR, "")
    assert re.fullmatch(r"\s*fishctl: no fishd at [^\n]*\n", after)


def test_it_follows_the_terminal_through_any_size_without_colour_if_asked(daemon: Daemon) -> None:
    terminal = Terminal(daemon, NO_COLOR="1")
    terminal.wait_for("lost")
    for size in ((3, 1), (20, 5), (60, 15), (200, 60)):
        terminal.resize(*size)
        terminal.wait_for("\x1b\\[H")
    terminal.wait_for(f"[\u2500-\u28ff ]{{{150}}}")
    terminal.signal(signal.SIGINT)
    assert terminal.finish() == 0
    assert not COLOUR.search(terminal.text)


def tick(seq: int, time: float | None = None, **fields: Any) -> Tick:
    """Return a tick of a loop of 50 ms, with a wave on both forces."""
    numbers = {name: 0.0 for name in Tick.__struct_fields__ if name not in ("alpha", "phi")}
    wave = {"fx": 0.02 + 0.02 * math.sin(0.5 * seq), "fy": 0.2 * math.sin(0.25 * seq)}
    what = {"seq": seq, "mode": "running", "controller": "swing", "servo_on": True}
    what["missed_slots"] = 0
    return Tick(**numbers | what | wave | {"time": 0.05 * seq if time is None else time} | fields)


def status(**fields: Any) -> Status:
    none = Percentiles(0.0, 0.0, 0.0, 0)
    timing = Timing(none, none, {})
    return Status(
        **dict.fromkeys(Status.__struct_fields__, 0)
        | {"mode": "running", "reason": None, "controller": "swing", "parameters": {"C": 0.6}}
        | {"timing": timing, "tick": 0.05, "fallback": None, "force_unit": "N", "robot": "pi"}
        | {"readings": {}}
        | fields
    )


def render(view: View, width: int = 80, height: int = 24) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height)
    lines = console.render_lines(Screen(view))
    return ["".join(segment.text for segment in line).rstrip() for line in lines]


def still_trace(screen: list[str]) -> str:
    """Return the row of zero of the last trace, which is constant."""
    return [row for row in screen if " 0\u2524" in row][-1]


def view_of(ticks: Iterable[Tick], **fields: Any) -> View:
    view = View(status(**fields))
    for one_tick in ticks:
        view.add(one_tick)
    return view


def test_lost_ticks_are_counted_and_leave_a_gap_in_the_traces() -> None:
    complete = render(view_of(map(tick, range(1, 101))))
    holed = render(view_of(tick(seq) for seq in range(1, 101) if not 40 <= seq < 60))
    assert complete[2].split()[-1] == "0"
    assert holed[2].split()[-1] == "20"
    gap = re.compile("[\u2801-\u28ff][ \u2800]{8,}[\u2801-\u28ff]")
    assert gap.search(still_trace(holed))
    assert not gap.search(still_trace(complete))


def test_readings_are_in_the_screen_in_status_and_in_the_line_of_watch() -> None:
    about = {"description": "", "low": None, "high": None}
    readings = {
        "power": ReadingState(
            unit="W", sensor="meter", value=0.6712, age=0.01, problem=None, **about
        ),
        "flow": ReadingState(
            unit="L/min", sensor="pump", value=1.5, age=3.2, problem=None, **about
        ),
        "depth": ReadingState(
            unit="m", sensor="pump", value=None, age=None, problem="no depth", **about
        ),
    }
    shown = status(readings=readings)
    screen = "\n".join(render(view_of(map(tick, range(1, 101)), readings=readings)))
    assert "power 671 mW   flow 1.5 L/min   depth –" in screen
    assert "power   671 mW  flow 1.5 L/min  depth        –" in status_line(shown)
    assert _reading_rows(shown) == [
        ("meter", "power 671 mW"),
        ("pump", "flow 1.5 L/min (3 s old), depth –"),
    ]


def test_it_shows_which_experiment_holds_the_fish() -> None:
    holder = LeaseHolder(name="sweep", host="lab", pid=7, age=65.2)
    held = "held by sweep (pid 7 on lab), for 65 s"
    assert held in render(view_of(map(tick, range(1, 101)), lease=holder))
    assert held not in render(view_of(map(tick, range(1, 101))))


def test_a_step_of_the_unix_clock_leaves_the_traces_as_they_are() -> None:
    steps = (0.0, -30.0, 1.7e9)
    screens = [
        render(view_of(tick(seq, t=1e9 + 0.05 * seq + step * (seq > 50)) for seq in range(1, 101)))
        for step in steps
    ]
    assert screens[0] == screens[1] == screens[2]


def test_a_daemon_that_was_restarted_is_not_a_loss() -> None:
    after = [tick(seq, time=60.0 + 0.05 * seq) for seq in range(1, 50)]
    assert render(view_of([*map(tick, range(1000, 1050)), *after]))[2].split()[-1] == "0"


def test_late_and_busy_are_the_worst_of_the_ticks_shown() -> None:
    early = tick(1, lateness_us=9999.0)
    bad = tick(150, lateness_us=777.0, busy_time_us=888.0)
    late = render(view_of([early, *map(tick, range(2, 150)), bad, *map(tick, range(151, 200))]))
    assert "777 µs" in late[2]
    assert "888 µs" in late[2]


def test_in_slow_motion_the_timing_is_not_shown() -> None:
    screen = render(view_of(map(tick, range(1, 50)), robot="swimmer"))
    assert "tail beat" in screen[1]
    assert not re.search("late|compute|skipped", screen[1])


def test_a_fault_is_explained_in_full_however_narrow_the_screen() -> None:
    message = "no force sample for 0.15 s: is the sensor's cable plugged in at both of its ends?"
    reason = Reason("sensor-stale", message)
    faulty = view_of([tick(1, mode="fault", servo_on=False)], mode="fault", reason=reason)
    screen = render(faulty, width=30, height=24)
    assert screen[0].startswith(" FAULT ")
    assert message in " ".join(screen)
    assert "no pulses" in render(faulty)[0]


def test_a_lost_sensor_or_servo_and_a_controller_that_took_over_are_shown() -> None:
    why = Reason("chatter", "ppo gave up: in 30 of the last 40 ticks it wanted to reverse too soon")
    screen = render(view_of([tick(1)], sensor_lost=True, servo_lost=True, fallback=why), width=120)
    assert screen[0].startswith(" RUNNING ")
    assert "servo not reached" in screen[0]
    assert screen[1] == f"took over: chatter: {why.message}"
    assert "– mN" in screen[3]


def test_quantities_of_the_controller_are_on_the_screen_with_their_units() -> None:
    values = {"top_speed": 2.3144, "since_reversal": 0.15}
    screen = render(view_of([tick(1, quantities=values)], quantity_units={"since_reversal": "s"}))
    assert screen[3].split() == ["top_speed", "2.31", "since_reversal", "0.15", "s"]


def test_the_status_is_requested_every_second_and_when_mode_or_controller_change() -> None:
    assert not view_of([tick(1, time=100.5)], clock=100.0).outdated
    assert view_of([tick(1, time=101.0)], clock=100.0).outdated
    assert view_of([tick(1, time=100.5, mode="estop")], clock=100.0).outdated
    assert view_of([tick(1, time=100.5, controller="sine")], clock=100.0).outdated


def test_any_size_of_screen_is_filled_and_never_overflows() -> None:
    view = view_of(map(tick, range(1, 101)), reason=Reason("servo-link", "the cable is off"))
    for width in (1, 10, 27, 28, 60, 250):
        for height in (1, 2, 3, 5, 9, 15, 60):
            screen = render(view, width, height)
            assert len(screen) == height
            assert max(map(len, screen)) <= width


@pytest.mark.parametrize("period", [0.002, 0.05, 0.2])
def test_traces_are_whole_lines_at_any_period_of_the_loop(period: float) -> None:
    ticks = (tick(seq, time=period * seq) for seq in range(1, round(6.0 / period)))
    assert re.search("[\u2801-\u28ff]{60}", still_trace(render(view_of(ticks, tick=period))))
