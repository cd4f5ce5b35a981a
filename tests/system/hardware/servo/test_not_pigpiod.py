"""Other servers on pigpiod's port, and a pigpiod that is too old: each is named."""

import contextlib

import pytest
from rigs.other_servers import SERVERS, other_server
from rigs.pigpio_rig import GPIO, Bench, connect
from rigs.processes import PATIENCE

from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio_client import open_client
from fishd.hardware.servo.pigpio_pulses import neutralise
from fishd.virtual.pi.pigpiod import daemon

MUTE = ("silent", "closing", "http", "ftp")
"""Servers that send nothing by which they could be known."""


@pytest.mark.parametrize("name", sorted(SERVERS.keys() - MUTE))
def test_another_server_is_called_one_and_not_driven(name: str) -> None:
    with other_server(name) as port:
        problem = f"^pigpiod at 127.0.0.1:{port}: it is not pigpiod: it (answers|says) [^\n]+$"
        with pytest.raises(ServoError, match=problem):
            neutralise(1500.0, gpio=GPIO, host="127.0.0.1", port=port)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("silent", "no answer within 100 ms: it is not pigpiod, or it hangs"),
        ("http", "no answer within 100 ms: it is not pigpiod, or it hangs"),
        ("closing", "it closed the connection at once: it is not pigpiod, or its option -n does"),
    ],
)
def test_a_server_that_sends_nothing_may_be_another_one(name: str, reason: str) -> None:
    limit = PATIENCE if name == "closing" else 0.1
    with (
        other_server(name) as port,
        pytest.raises(ServoError, match=f"^pigpiod at 127.0.0.1:{port}: {reason}"),
        open_client("127.0.0.1", port, limit),
    ):
        pass


def test_without_updates_of_scripts_nothing_is_stored_or_driven(bench: Bench) -> None:
    bench.faults.inject("pigpiod-old")
    servo = bench.servo()
    with pytest.raises(ServoError, match=r"too old: it does not know PROCU, which the count"):
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
