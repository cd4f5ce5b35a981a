"""The link to pigpiod when a new client cannot be put in order, for whatever reason."""

import contextlib
from collections.abc import Iterator

import pytest

from fishd.core.clock import SystemClock, VirtualClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.servo.pigpio_client import Client
from fishd.hardware.servo.pigpio_link import PigpioLink
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.pigpiod.daemon import Pigpiod


@pytest.fixture
def settings() -> Iterator[PigpioSettings]:
    clock = VirtualClock()
    daemon = Pigpiod(clock, Faults(clock))
    daemon.start()
    with contextlib.closing(daemon):
        yield PigpioSettings(port=daemon.port)


def test_the_thread_outlives_an_error_that_nobody_thought_of(settings: PigpioSettings) -> None:
    attempts: list[Client] = []

    def prepare(client: Client) -> None:
        attempts.append(client)
        if len(attempts) == 1:
            raise IndexError("out of range")

    link = PigpioLink(settings, SystemClock(), prepare, threaded=True)
    with contextlib.closing(link), link.session(last=True) as client:
        assert client is attempts[1]
        with pytest.raises(OSError, match="Bad file descriptor"):
            attempts[0].get_pigpio_version()


def test_an_unforeseen_error_is_the_reason_why_there_is_no_connection(
    settings: PigpioSettings,
) -> None:
    def prepare(client: Client) -> None:
        raise IndexError("out of range")

    with (
        contextlib.closing(PigpioLink(settings, VirtualClock(), prepare, threaded=False)) as link,
        pytest.raises(ServoError, match="not connected: out of range"),
        link.session(),
    ):
        pass
