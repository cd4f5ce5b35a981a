"""Other servers on pigpiod's port, and a pigpiod that is too old: each is named."""

import contextlib
import inspect
from pathlib import Path

import pytest
from rigs.doctor_tree import put
from rigs.other_servers import SERVERS, other_server
from rigs.pigpio_rig import GPIO, Bench, connect
from rigs.processes import PATIENCE

from fishd.core.errors import ServoError
from fishd.hardware.checks import Machine, Result
from fishd.hardware.servo import pigpio_client
from fishd.hardware.servo.pigpio import Pigpio, PigpioSettings
from fishd.hardware.servo.pigpio_client import open_client
from fishd.hardware.servo.pigpio_pulses import neutralise
from fishd.virtual.pi.pigpiod import daemon

MUTE = ("silent", "closing")
"""Servers that send nothing by which they could be known."""


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give servers that answer a long time, so that a busy machine fails no test."""
    monkeypatch.setattr(pigpio_client, "_PROVOCATION_S", PATIENCE)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("name", sorted(SERVERS.keys() - MUTE))
def test_another_server_is_called_one_and_not_driven(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = 0.5 if name in ("http", "ftp") else PATIENCE  # those two wait for an end of a line
    monkeypatch.setattr(inspect.unwrap(open_client), "__defaults__", (limit,))
    with other_server(name) as port:
        problem = f"^what answers at 127.0.0.1:{port} is not pigpiod: it (sends|says) [^\n]+$"
        with pytest.raises(ServoError, match=problem):
            neutralise(1500.0, gpio=GPIO, host="127.0.0.1", port=port)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("silent", "no answer within 100 ms: it is not pigpiod, or it hangs"),
        ("closing", "it closed the connection at once: it is not pigpiod, or its option -n does"),
    ],
)
def test_a_server_that_sends_nothing_may_be_another_one(name: str, reason: str) -> None:
    limit = 0.1 if name == "silent" else PATIENCE
    with (
        other_server(name) as port,
        pytest.raises(ServoError, match=f"^pigpiod at 127.0.0.1:{port}: {reason}"),
        open_client("127.0.0.1", port, limit),
    ):
        pass


class Board(Machine):
    """Board whose /proc a test writes."""

    is_virtual = False

    def occupied(self, by_fishd: str) -> Result | None:
        return None


@pytest.mark.parametrize("name", MUTE)
def test_doctor_looks_for_a_process_of_pigpiod_where_nothing_is_sent(
    name: str, tmp_path: Path
) -> None:
    board = Board()
    board.root = tmp_path
    with other_server(name) as port:
        (check,) = Pigpio.checks(PigpioSettings(port=port))

        def examine() -> str:
            result = check.function(board)
            assert result
            assert result.level == "FAIL"
            return f"{result.message}; {result.remedy}"

        assert "sudo systemctl restart pigpiod" in examine(), "this user may not see processes"
        put(board.root, "proc/1/comm", "sh\n")
        line = examine()
        assert "is perhaps not pigpiod, of which no process is visible here" in line, "a container"
        assert "if pigpiod runs outside of this container, restart it" in line
        put(board.root, "proc/1/comm", "systemd\n")
        put(board.root, "proc/2/comm", "kthreadd\n")
        line = examine()
        assert line.startswith(f"what answers at 127.0.0.1:{port} is not pigpiod, of which there ")
        assert "stop that program" in line
        assert "restart" not in line
        put(board.root, "proc/77/comm", "pigpiod\n")
        assert "sudo systemctl restart pigpiod" in examine()


@pytest.mark.parametrize(
    "command",
    ["PROC", "PROCD", "PROCP", "PROCR", "PROCU", "SERVO", "GPW", "GDC", "MODEG", "READ"],
)
def test_without_one_of_the_commands_nothing_is_stored_or_driven(
    bench: Bench, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daemon, "UNKNOWN_TO_OLD", frozenset({command}))
    bench.faults.inject("pigpiod-old")
    servo = bench.servo()
    with pytest.raises(ServoError, match=rf"too old: it does not know {command}, which the count"):
        connect(servo)
    with contextlib.suppress(ServoError):
        servo.write(0.5)
    bench.faults.clear()
    assert bench.width == 0
    assert bench.scripts() == 0


def test_pulses_on_an_old_pigpiod_end_without_a_countdown(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown = frozenset({"PROC", "PROCD", "PROCP", "PROCR", "PROCU"})
    monkeypatch.setattr(daemon, "UNKNOWN_TO_OLD", unknown)
    bench.faults.inject("pigpiod-old")
    with bench.client() as client:
        client.set_servo_pulsewidth(GPIO, 1800)
    bench.wait(0.1)
    assert bench.last_resort()
    assert [width for _, width in bench.daemon.history(GPIO)] == [1800, 1500, 0]
    assert not bench.last_resort(), "there are no pulses any more"
