"""The camera of a fish in a window: its pictures for pages, and what is drawn into them."""

import asyncio
import itertools
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import aiohttp
import msgspec
import pytest
from rigs.camera_process import running_camera
from rigs.processes import Daemon
from rigs.window_process import Browser, WindowProcess, running_window

from fishd.camera import client as camera_client
from fishd.camera.messages import CameraState, Crop, PublishedView, TailMessage, ViewHeader
from fishd.window import camera_feed
from fishd.window.camera_feed import CameraFeed, CameraViewer

DRAWN = '["drawn"]'


class Camera:
    """A page's connection to a camera."""

    def __init__(self, sock: aiohttp.ClientWebSocketResponse) -> None:
        self.sock = sock

    async def facts(self, true: Callable[[Any], bool]) -> Any:
        """Return the first facts for which a condition holds."""
        async for message in self.sock:
            if message.type is aiohttp.WSMsgType.TEXT:
                kind, payload = msgspec.json.decode(message.data)
                if kind == "facts" and true(payload):
                    return payload
        raise AssertionError("closed")

    async def picture(self) -> tuple[Any, bytes]:
        """Return what is drawn into the next picture, and the picture."""
        header: Any = None
        async for message in self.sock:
            if message.type is aiohttp.WSMsgType.BINARY:
                return header, message.data
            kind, payload = msgspec.json.decode(message.data)
            header = payload if kind == "picture" else None
        raise AssertionError("closed")


@asynccontextmanager
async def open_camera(window: WindowProcess, fish: str = "fish") -> AsyncIterator[Camera]:
    async with (
        Browser(window.url) as browser,
        browser.session.ws_connect(f"/camera?fish={fish}", max_msg_size=0) as sock,
    ):
        yield Camera(sock)


async def test_a_page_gets_pictures_the_axis_on_request_and_a_lost_camera_again(
    daemon: Daemon, tmp_path: Path
) -> None:
    settings = f"simulated.fishd={daemon.endpoint}"
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        async with open_camera(window) as camera:
            lost = await camera.facts(lambda facts: True)
            assert lost["is_lost"]
            assert f"no camera at ipc://{tmp_path}/camera-requests" in lost["title"]
            assert "start one with 'fishd-camera'" in lost["title"]
            with running_camera(tmp_path, settings, "simulated.rate=30"):
                header, jpeg = await camera.picture()
                assert jpeg.startswith(b"\xff\xd8")
                assert header["size"] == [640, 480]
                assert header["crop"] == [0.125, 0.0, 0.75, 1.0]
                facts = await camera.facts(lambda facts: "axis" in facts)
                assert facts["title"].startswith("streaming: a simulated camera above the fish")
                assert facts["axis"] is None
                assert (
                    "fin angle: not learned: run fishctl camera measure --learn" in facts["lines"]
                )
                assert daemon.fishctl("set-controller", "swing").returncode == 0
                await camera.sock.send_str('["align",true]')
                facts = await camera.facts(lambda facts: facts["axis"])
                assert facts["axis"][2] == 84
                assert abs(facts["axis"][0]) < 1.0
            lost = await camera.facts(lambda facts: facts.get("is_lost"))
            await camera.sock.send_str(DRAWN)
            with running_camera(tmp_path, settings):
                await camera.picture()


async def test_a_fish_without_a_camera_says_so(daemon: Daemon, tmp_path: Path) -> None:
    fish = {"tuna": daemon.endpoint, "bream": daemon.endpoint}
    with running_window(tmp_path, **fish) as window:
        async with Browser(window.url) as browser:
            assert await browser.refusal("/camera?fish=bream") == (404, "no-camera")
            assert await browser.refusal("/camera?fish=none") == (404, "no-fish")
            assert await browser.get("/api/fish/bream/about/camera") == []
        async with open_camera(window, "tuna") as camera:
            assert (await camera.facts(lambda facts: True))["is_lost"]


class FakeClient:
    """Connection to a camera with pictures that a test gives."""

    open_count = 0
    views: Iterator[int] = iter(())
    tails: tuple[TailMessage, ...] = ()
    state: CameraState

    def __init__(self, *_: object, **__: object) -> None:
        self.latest, self.view, self.missed = None, None, 0

    def __enter__(self) -> Self:
        FakeClient.open_count += 1
        return self

    def __exit__(self, *_: object) -> None:
        FakeClient.open_count -= 1

    def poll(self, seconds: float) -> list[Any]:
        if number := next(FakeClient.views, 0):
            crop = Crop(left=0.1, top=0.2, width=0.5, height=0.5)
            header = ViewHeader(session="s", seq=number, time=0.0, width=84, height=84, crop=crop)
            self.view = PublishedView(header, b"%d" % number)
        return []

    def take_tails(self) -> tuple[TailMessage, ...]:
        tails, FakeClient.tails = FakeClient.tails, ()
        return tails

    def check(self) -> None:
        pass


def make_state(**changes: Any) -> CameraState:
    fields: dict[str, Any] = {
        "t": 0.0, "version": "", "pid": 1, "uptime": 1.0, "session": "s", "source": "v4l2",
        "device": "/dev/video0", "state": "streaming", "since": 0.0, "width": 84, "height": 84,
        "picture_width": 640, "picture_height": 480, "frames": "",
    }  # fmt: skip
    return CameraState(**(fields | changes))


@pytest.fixture
def feed(monkeypatch: pytest.MonkeyPatch) -> CameraFeed:
    monkeypatch.setattr(camera_client, "CameraClient", FakeClient)
    FakeClient.views, FakeClient.tails, FakeClient.state = iter(()), (), make_state()
    link = SimpleNamespace(name="fish", listeners=set(), status=None)
    return CameraFeed(None, link)  # type: ignore[arg-type]


async def receive(viewer: CameraViewer, wanted: str) -> tuple[Any, bytes]:
    """Return the first message of a kind, as a page takes it, and the picture if it is one."""
    while True:
        messages = list(viewer.take())
        for kind, message in itertools.pairwise([*messages, b""]):
            if isinstance(kind, str) and msgspec.json.decode(kind)[0] == wanted:
                return msgspec.json.decode(kind)[1], message if wanted == "picture" else b""
        await asyncio.sleep(0.001)


async def test_a_camera_is_followed_only_while_a_page_shows_it(feed: CameraFeed) -> None:
    for _ in range(2):
        with feed.open("") as first:
            await receive(first, "facts")
            with feed.open("") as second:
                await receive(second, "facts")
                assert FakeClient.open_count == 1
            await receive(first, "facts")
            assert FakeClient.open_count == 1
        while FakeClient.open_count:
            await asyncio.sleep(0.001)
        assert feed._link.listeners == set()


def make_tail(seq: int) -> TailMessage:
    return TailMessage(
        time=0.0, alpha=0.25, zero=0.0, uncertainty=0.01, reason="blurred", session="s", seq=seq,
        midline=((10.0, 20.0), (30.0, 25.0)),
    )  # fmt: skip


async def test_the_tail_is_drawn_into_the_picture_in_which_it_was_measured(
    feed: CameraFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_feed, "MIDLINE_TIMEOUT_S", 1e6)
    FakeClient.state = make_state(tail="measuring")
    FakeClient.views = iter([5])
    with feed.open("") as viewer:
        FakeClient.tails = (make_tail(4),)
        await receive(viewer, "facts")
        assert not any(isinstance(message, bytes) for message in viewer.take())
        FakeClient.tails = (make_tail(5),)
        header, jpeg = await receive(viewer, "picture")
    assert jpeg == b"5"
    assert header == {
        "crop": [0.1, 0.2, 0.5, 0.5], "size": [640, 480], "midline": [[10.0, 20.0], [30.0, 25.0]],
        "alpha": 0.25, "uncertainty": 0.01, "reason": "blurred",
    }  # fmt: skip


async def test_a_picture_that_is_not_measured_in_time_is_shown_without_a_tail(
    feed: CameraFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_feed, "MIDLINE_TIMEOUT_S", 0.0)
    FakeClient.state = make_state(tail="measuring")
    FakeClient.views = iter([5])
    with feed.open("") as viewer:
        header, _ = await receive(viewer, "picture")
    assert (header["midline"], header["alpha"], header["reason"]) == ([], None, "")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"state": "stalled", "problem": "no frame", "remedy": "plug it in"},
            ["no frame", "plug it in"],
        ),
        ({"rate": 30.0, "latency": 0.012}, ["30.0 pictures a second, 12 ms old when they come"]),
        (
            {"dropped_frames": 2, "broken_frames": 1, "unmeasured_pictures": 7},
            ["2 not delivered, 1 broken, 7 not measured for lack of time"],
        ),
        ({"tail": "unusable", "tail_problem": "old file"}, ["fin angle: old file"]),
        ({"limitations": ("times are late",)}, ["times are late"]),
        ({}, ["it sends no pictures for people: publish.view_rate of its settings is 0"]),
    ],
)
async def test_the_facts_are_state_rate_losses_and_what_to_do(
    feed: CameraFeed, changes: dict[str, Any], expected: list[str]
) -> None:
    FakeClient.state = make_state(**changes)
    with feed.open("") as viewer:
        facts, _ = await receive(viewer, "facts")
    assert facts["title"] == f"{FakeClient.state.state}: /dev/video0"
    assert set(expected) <= set(facts["lines"])


async def test_a_picture_that_is_too_large_is_not_sent_and_the_page_says_so(
    feed: CameraFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_feed, "MAX_PICTURE_BYTES", 1)
    FakeClient.views = iter([10, 5])
    with feed.open("") as viewer:
        _, jpeg = await receive(viewer, "picture")
        assert jpeg == b"5"
    FakeClient.views = iter([10])
    with feed.open("") as viewer:
        facts, _ = await receive(viewer, "facts")
    assert "its pictures are too large for the page: reduce publish.view_width" in facts["lines"]


async def test_a_mistake_in_the_thread_is_shown_and_it_goes_on(
    feed: CameraFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera_feed, "RETRY_S", 0.0)
    FakeClient.views = itertools.count(5)
    describe, is_broken = camera_feed._describe, True

    def fail(*arguments: Any) -> str:
        if is_broken:
            raise ValueError("broken")
        return describe(*arguments)

    monkeypatch.setattr(camera_feed, "_describe", fail)
    with feed.open("") as viewer:
        facts, _ = await receive(viewer, "facts")
        assert (facts["title"], facts["is_lost"]) == ("ValueError: broken", True)
        is_broken = False
        while "is_lost" in facts:
            facts, _ = await receive(viewer, "facts")
        assert facts["title"] == "streaming: /dev/video0"
