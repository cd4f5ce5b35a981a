"""Loop of `fishd-camera` with a faulty driver."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from rigs.processes import PATIENCE, wait_until

from fishd.camera import server
from fishd.camera.client import CameraClient
from fishd.camera.messages import CameraState
from fishd.camera.server import Server
from fishd.camera.settings import load
from fishd.camera.sockets import Publisher
from fishd.camera.sources.base import Shot, Sink, Source, Timeline
from fishd.core.camera_frames import StackSettings

Stopping = Callable[[float], bool]
pytestmark = pytest.mark.slow
TICK = 0.05


class FailsOnce:
    device = "a camera"

    def __init__(self) -> None:
        self.runs = 0
        self.goes_on = threading.Event()

    def run(self, sink: Sink, stopping: Stopping) -> None:
        self.runs += 1
        if self.runs == 1:
            raise ZeroDivisionError("in a library")
        self.goes_on.wait(PATIENCE)
        sink.begin(Timeline(False, "", None))
        picture = np.full((120, 160), 7, np.uint8)
        number = 0
        while not stopping(0.01):
            number += 1
            sink.put(Shot(0.01 * number, 0.01 * number, picture))


class Hangs:
    device = "a camera"

    def __init__(self) -> None:
        self.goes_on = threading.Event()

    def run(self, sink: Sink, stopping: Stopping) -> None:
        self.goes_on.wait(PATIENCE)
        while not stopping(0.01):
            sink.put(Shot(1.0, 1.0, np.zeros((120, 160), np.uint8)))


class TwoTicks:
    """Source in lockstep, whose ticks come when a test releases them."""

    device = "a camera"

    def __init__(self) -> None:
        self.lets = threading.Semaphore(0)

    def run(self, sink: Sink, stopping: Stopping) -> None:
        sink.begin(Timeline(True, "", None))
        for number in (1, 2):
            self.lets.acquire(timeout=PATIENCE)
            picture = np.full((120, 160), number, np.uint8)
            sink.put(Shot(number * TICK, number * TICK, picture))
            sink.covered(number * TICK)
        while not stopping(0.01):
            sink.alive()


@contextmanager
def serving(
    folder: Path, source: Source, stack: StackSettings | None = None
) -> Iterator[CameraClient]:
    stopping = threading.Event()
    endpoint = f"ipc://{folder}/r"
    pairs = (f"publish.requests={endpoint}", f"publish.frames=ipc://{folder}/f")
    with Server(load(None, pairs), source, folder / "tail.bin") as camera_server:
        thread = threading.Thread(target=camera_server.run, args=(stopping.is_set,))
        thread.start()
        try:
            with CameraClient(endpoint, stack=stack, timeout=PATIENCE) as client:
                yield client
        finally:
            stopping.set()
            thread.join(PATIENCE)


def test_an_error_that_nobody_expected_is_said_and_the_camera_opened_again(tmp_path: Path) -> None:
    source = FailsOnce()
    with serving(tmp_path, source) as client:
        problem = "a camera cannot be used: ZeroDivisionError: in a library"
        wait_until(lambda: client.status().problem == problem)
        source.goes_on.set()
        (frame, *_) = client.poll(PATIENCE)
        assert np.all(frame.pixels == 7)
        wait_until(lambda: client.status().state == "streaming")
        assert client.status().problem == ""


def test_a_driver_that_hangs_is_said_while_requests_are_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "SOURCE_TIMEOUT_S", 0.1)
    source = Hangs()
    with serving(tmp_path, source) as client:
        wait_until(lambda: client.status().state == "stalled")
        assert "it hangs" in client.status().problem
        source.goes_on.set()
        wait_until(lambda: client.status().state == "streaming")


def test_an_answer_that_comes_before_its_frame_does_not_leave_that_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    holding, held, send = threading.Event(), list[list[bytes]](), Publisher.send

    def send_later(publisher: Publisher, parts: list[bytes]) -> None:
        held.append(parts)
        while held and not holding.is_set():
            send(publisher, held.pop(0))

    monkeypatch.setattr(Publisher, "send", send_later)
    source = TwoTicks()
    with serving(tmp_path, source, StackSettings(frames=1)) as client:
        ask = client.status

        def ask_and_let_go() -> CameraState:
            state = ask()
            holding.clear()
            return state

        def is_in_lockstep() -> bool:
            client.poll()
            return client.state.virtual

        wait_until(is_in_lockstep)
        source.lets.release()
        wait_until(lambda: ask().until == TICK)
        first = client.stack_at(TICK)
        holding.set()
        source.lets.release()
        wait_until(lambda: ask().until == 2 * TICK)
        monkeypatch.setattr(client, "status", ask_and_let_go)
        second = client.stack_at(2 * TICK)
    assert (first[0][0, 0], second[0][0, 0]) == (1, 2)
