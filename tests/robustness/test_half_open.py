"""Connections that die without an end, as in a router that forgets them.

Nothing waits for ever, and what is lost is counted and said.
"""

import asyncio
import json
import logging
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from rigs import half_open
from rigs.camera_process import COMMAND
from rigs.distant_daemon import DistantDaemon, running_at_a_distance
from rigs.half_open import HOST, PATH_HOST
from rigs.processes import (
    FISHCTL,
    PATIENCE,
    Daemon,
    Process,
    reserve_port,
    running,
    sets,
    wait_until,
)

from fishd.camera.requests import CameraLost, CameraRequests
from fishd.cli.recording.record import INCOMPLETE
from fishd.client import AsyncFish, Fish, NoDaemon
from fishd.core.errors import RecordingError
from fishd.recording import open_run


@pytest.fixture
def distant(tmp_path: Path) -> Iterator[DistantDaemon]:
    with running_at_a_distance(tmp_path, "--set", "start.controller=swing") as daemon:
        yield daemon


class Recording(Process):
    """`fishctl record` at the other end of the path."""

    def __init__(self, daemon: DistantDaemon, folder: Path, *words: str) -> None:
        self.folder = folder
        where = ("--endpoint", daemon.distant_endpoint)
        super().__init__(FISHCTL, *where, "record", "--json", "--folder", str(folder), *words)

    def wait_for_tick(self, seq: int) -> None:
        """Wait until the file holds a tick of this number or a later one."""
        wait_until(lambda: any(tick.seq >= seq for tick in self.ticks()))

    def ticks(self) -> list[Any]:
        """Return the ticks that are in the unfinished file; none if it has just begun."""
        try:
            return open_run(next(self.folder.glob("*.part"))).ticks
        except (StopIteration, RecordingError):
            return []


def lost_in(lines: str) -> list[int]:
    """Return the losses that a recorder has reported."""
    return [int(number) for number in re.findall(r"ticks were lost: (\d+)", lines)]


def missing_in(seqs: list[int]) -> int:
    """Return how many numbers are missing between the first and the last."""
    return seqs[-1] - seqs[0] + 1 - len(seqs)


def test_a_recorder_connects_again_and_counts_what_a_router_forgot(
    distant: DistantDaemon, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    with Recording(distant, runs, "run") as recording:
        recording.wait_for_tick(1)
        distant.path.forget(distant.telemetry_port)
        recording.wait_for_tick(distant.seq + 40)  # it has connected again
        status, out, lines = recording.end()
    run = open_run(runs / "run.mcap")
    missing = missing_in([tick.seq for tick in run.ticks])
    assert missing > 20  # the silence until it was noticed
    assert lost_in(lines) == [missing]
    assert "answers, but nothing arrives from its telemetry" in lines
    assert "arrives again" in lines
    assert status == INCOMPLETE
    said = json.loads(out)
    assert (said["lost_ticks"], said["complete"]) == (missing, False)
    assert run.summary.lost_ticks == missing


def test_a_recorder_whose_telemetry_never_returns_counts_what_it_lost_at_the_end(
    distant: DistantDaemon, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    with Recording(distant, runs, "run") as recording:
        recording.wait_for_tick(1)
        distant.path.cut(distant.telemetry_port)
        last = recording.ticks()[-1].seq + 150
        wait_until(lambda: distant.seq > last)
        before = distant.seq
        status, out, lines = recording.end()
        after = distant.seq
    stored = [tick.seq for tick in open_run(runs / "run.mcap").ticks]
    (lost,) = lost_in(lines)
    assert before <= stored[-1] + lost <= after
    assert status == INCOMPLETE
    assert json.loads(out)["lost_ticks"] == lost
    assert open_run(runs / "run.mcap").summary.lost_ticks == lost


def test_a_recorder_that_begins_in_silence_counts_from_its_beginning(
    distant: DistantDaemon, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    distant.path.cut(distant.telemetry_port)
    begin = distant.seq
    with Recording(distant, runs, "run") as recording:
        wait_until(lambda: bool(list(runs.glob("*.part"))))
        begun = distant.seq
        wait_until(lambda: distant.seq > begun + 80)
        distant.path.restore(distant.telemetry_port)
        recording.wait_for_tick(distant.seq)
        status, _, lines = recording.end()
    ticks = open_run(runs / "run.mcap").ticks
    (lost,) = lost_in(lines)
    assert begin <= ticks[0].seq - lost - 1 <= begun
    assert status == INCOMPLETE


def test_a_recorder_that_is_cut_off_altogether_does_not_claim_to_be_complete(
    distant: DistantDaemon, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    with Recording(distant, runs, "run") as recording:
        recording.wait_for_tick(1)
        distant.path.cut(distant.telemetry_port, distant.control_port)
        last = recording.ticks()[-1].seq + 60
        wait_until(lambda: distant.seq > last)
        status, out, lines = recording.end()
    run = open_run(runs / "run.mcap")
    assert f"whether ticks after tick {run.ticks[-1].seq} were lost is not known" in lines
    assert (status, json.loads(out)["complete"]) == (INCOMPLETE, False)
    assert "is not known" in run.reason


def test_a_recording_without_a_loss_ends_with_zero(distant: DistantDaemon, tmp_path: Path) -> None:
    with Recording(distant, tmp_path / "runs", "run", "--for", "1") as recording:
        status, out, lines = recording.finish()
    said = json.loads(out)
    assert (status, said["lost_ticks"], said["complete"], lost_in(lines)) == (0, 0, True, [])
    assert said["ticks"] > 10


def test_events_arrive_again_after_a_silence_and_the_loss_is_logged(
    distant: DistantDaemon, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[list[str]] = [[], []]

    def listen() -> None:
        with Fish(distant.distant_endpoint) as fish:
            for event in fish.events():
                heard[0].append(event.message)
                if event.message == "after":
                    return

    async def listen_to_more() -> None:
        async with AsyncFish(distant.distant_endpoint) as fish:
            async for event in fish.events():
                heard[1].append(event.message)
                if event.message == "after":
                    return

    threads = [
        threading.Thread(target=listen, daemon=True),
        threading.Thread(target=lambda: asyncio.run(listen_to_more()), daemon=True),
    ]
    with caplog.at_level(logging.WARNING), Fish(distant.endpoint, timeout=PATIENCE) as sender:
        with Fish(distant.distant_endpoint) as fish:
            ticks = fish.ticks()
            next(ticks)
            for thread in threads:
                thread.start()
            wait_until(lambda: _mark(sender, "before") and all(heard))
            seen = next(ticks).seq
            distant.path.forget(distant.telemetry_port, distant.control_port)
            assert next(tick.seq for tick in ticks if tick.seq > seen + 20)
        wait_until(lambda: len(caplog.messages) >= 3 or not _mark(sender, "during"))
        for thread in threads:
            wait_until(lambda thread=thread: _mark(sender, "after") and not thread.is_alive())
    assert [messages[-1] for messages in heard] == ["after", "after"]
    assert any("arrives again" in message for message in caplog.messages)


def _mark(sender: Fish, text: str) -> bool:
    return sender.mark(text).seq > 0


def test_ticks_that_never_return_are_an_error_that_says_that_fishd_answers(
    distant: DistantDaemon,
) -> None:
    with Fish(distant.distant_endpoint) as fish:
        ticks = fish.ticks()
        next(ticks)
        distant.path.cut(distant.telemetry_port)
        with pytest.raises(NoDaemon, match=rf"answers, but nothing arrives .*{PATH_HOST}.*reach"):
            list(ticks)
        assert fish.status().seq > 0


def test_a_request_after_one_that_a_router_forgot_is_answered(distant: DistantDaemon) -> None:
    with Fish(distant.distant_endpoint) as fish:
        fish.status()
        distant.path.forget(distant.control_port)
        with pytest.raises(NoDaemon, match="no answer"):
            fish.status()
        assert fish.status().seq > 0


def test_a_measurement_that_lost_ticks_is_lost_and_says_why(
    distant: DistantDaemon, tmp_path: Path
) -> None:
    words = ("measure", "swing", "--for", "21", "--folder", str(tmp_path / "measure"))
    distant.at_rest()
    with Process(FISHCTL, "--endpoint", distant.distant_endpoint, *words) as measure:
        wait_until(lambda: distant.status().mode == "running")
        seq = distant.seq
        wait_until(lambda: distant.seq > seq + 20)
        distant.path.forget(distant.telemetry_port)
        status, _, lines = measure.finish()
    assert status == 1
    assert "nothing arrives from its telemetry" in lines
    assert re.search(r"\d+ of \d+ ticks were lost on their way from fishd", lines)


def test_a_name_that_is_not_known_is_said_to_be_so(tmp_path: Path) -> None:
    for host, why in (
        ("fish_1.invalid", "the name fish_1.invalid is not known"),
        ("[fe80::1%eth9]", "this machine has no network interface eth9"),
    ):
        endpoint = f"tcp://{host}:9871"
        with Fish(endpoint, timeout=0.1) as fish, pytest.raises(NoDaemon) as caught:
            fish.status()
        assert why in str(caught.value)
        assert "start one" not in str(caught.value)
        lost = pytest.raises(CameraLost, match=re.escape(why))
        with CameraRequests(endpoint, 0.1) as camera, lost:
            camera.status()
    with running(tmp_path) as daemon:
        fish = Fish(daemon.endpoint, timeout=0.1, telemetry="tcp://fish_1.invalid:9872")
        with fish, pytest.raises(NoDaemon, match=r"answers, but .*fish_1.invalid is not known"):
            next(fish.ticks())


class DistantCamera(NamedTuple):
    """A camera above the fish of a fishd, and the path to it."""

    daemon: Daemon
    path: half_open.Path
    requests_port: int
    frames_port: int

    @property
    def endpoint(self) -> str:
        """Address of the requests at the other end of the path."""
        return f"tcp://{PATH_HOST}:{self.requests_port}"

    @property
    def seq(self) -> int:
        """Number of the latest frame, requested without the path; 0 without an answer."""
        with CameraRequests(f"tcp://{HOST}:{self.requests_port}", 1.0) as requests:
            try:
                return requests.status().seq
            except CameraLost:
                return 0


def last_frame(folder: Path) -> int:
    """Return the number of the latest frame in an unfinished recording; 0 without one."""
    try:
        heads = open_run(next(folder.glob("*.part"))).frame_heads
    except (StopIteration, RecordingError):
        return 0
    return heads[-1].seq if heads else 0


@pytest.fixture
def camera(tmp_path: Path) -> Iterator[DistantCamera]:
    with running(tmp_path) as daemon, reserve_port() as first, reserve_port() as second:
        ports = [socket.getsockname()[1] for socket in (first, second)]
        pairs = [
            f"publish.{name}=tcp://{HOST}:{port}"
            for name, port in zip(("requests", "frames"), ports, strict=True)
        ]
        source = ("source=simulated", f"simulated.fishd={daemon.endpoint}", "simulated.rate=20")
        with Process(*COMMAND, *sets(*source, *pairs)), half_open.Path(*ports) as path:
            camera = DistantCamera(daemon, path, *ports)
            wait_until(lambda: camera.seq > 0)
            yield camera


def test_frames_arrive_again_after_a_silence_and_the_lost_ones_are_counted(
    camera: DistantCamera, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    where = ("--endpoint", camera.daemon.endpoint, "record", "run", "--folder", str(runs))
    with Process(FISHCTL, *where, "--json", "--camera", camera.endpoint) as recording:
        wait_until(lambda: last_frame(runs) > 0)
        camera.path.forget(camera.frames_port)
        back = camera.seq + 60
        wait_until(lambda: last_frame(runs) > back)
        camera.path.cut(camera.frames_port)
        last = camera.seq + 20
        wait_until(lambda: camera.seq > last)
        before = camera.seq
        status, out, lines = recording.end()
        after = camera.seq
    said = json.loads(out)
    frames = [head.seq for head in open_run(runs / "run.mcap").frame_heads]
    between = missing_in(frames)
    assert between > 20
    assert before <= frames[-1] + said["lost_frames"] - between <= after
    assert "the camera is back" in lines
    assert re.search(rf"just before frame \d+, frames were lost: {between}\n", lines)
    assert re.search(r"at the end, frames were lost: \d+\n", lines)
    assert (status, said["lost_ticks"]) == (INCOMPLETE, 0)
