"""Foxglove and Lichtblick read the fish, through the same guards as the page."""

import json
import struct
import sys
from collections.abc import Iterator, Sequence
from typing import Any
from xml.etree import ElementTree

import aiohttp
import pytest
from rigs.documents import FENCE, ROOT
from rigs.processes import Daemon, Process
from rigs.window_process import NETWORK_HOST, Browser, WindowProcess, running_window

from fishd.core.schema import fields_of
from fishd.window.foxglove import CHANNELS, PROTOCOLS

LAYOUTS = ROOT / "config" / "layouts"
LICHTBLICK = "http://lichtblick.example:8080"


async def read_text(sock: aiohttp.ClientWebSocketResponse) -> dict[str, Any]:
    message: dict[str, Any] = json.loads(await sock.receive_str())
    return message


@pytest.mark.parametrize("protocols", [*([name] for name in PROTOCOLS), PROTOCOLS, PROTOCOLS[::-1]])
async def test_a_viewer_gets_the_ticks_to_which_it_subscribes(
    window: WindowProcess, protocols: Sequence[str]
) -> None:
    async with (
        Browser(window.url) as browser,
        browser.session.ws_connect("/foxglove", protocols=protocols) as sock,
    ):
        assert sock.protocol == protocols[0]
        info = await read_text(sock)
        assert (info["op"], info["capabilities"]) == ("serverInfo", [])
        channels = {c["topic"]: c for c in (await read_text(sock))["channels"]}
        assert set(channels) == set(CHANNELS)
        tick = channels["tick"]
        properties = json.loads(tick["schema"])["properties"]
        assert properties["fx"]["type"] == "number"
        assert properties["readings"]["properties"]["power"] == {
            "type": "number",
            "description": "Electrical power that the servo takes from its supply. [W]",
        }
        request = {"op": "subscribe", "subscriptions": [{"id": 7, "channelId": tick["id"]}]}
        await sock.send_str(json.dumps(request))
        seqs = []
        for _ in range(3):
            data = await sock.receive_bytes()
            opcode, number, nanoseconds = struct.unpack("<BIQ", data[:13])
            message = json.loads(data[13:])
            assert (opcode, number) == (1, 7)
            assert abs(nanoseconds * 1e-9 - message["t"]) < 0.1
            seqs.append(message["seq"])
        assert seqs == [seqs[0], seqs[0] + 1, seqs[0] + 2]


@pytest.mark.parametrize(
    "message",
    [
        '{"op": "setParameters", "parameters": [{"name": "x", "value": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}',
        '{"op": "subscribe", "subscriptions": 3}',
        "[" * 500,
    ],
)
async def test_a_viewer_can_only_read(window: WindowProcess, message: str) -> None:
    async with (
        Browser(window.url) as browser,
        browser.session.ws_connect("/foxglove", protocols=PROTOCOLS) as sock,
    ):
        await read_text(sock), await read_text(sock)
        await sock.send_str(message)
        assert (await read_text(sock))["level"] == 1


def test_the_program_of_the_page_pairs_and_prints_forces(window: WindowProcess) -> None:
    page = (ROOT / "docs" / "how-to" / "window.md").read_text(encoding="utf-8")
    (example,) = [code for _, code in FENCE.findall(page) if "/api/pair" in code]
    token = window.invite("watch").partition("#pair=")[2]
    with Process(sys.executable, "-u", "-c", example, window.url, token) as program:
        assert program.process.stdout
        assert abs(float(program.process.stdout.readline())) < 1.0


async def test_only_origins_of_the_settings_and_paired_devices_read(
    daemon: Daemon, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("origins")
    with running_window(
        folder, settings=f"origins: [{LICHTBLICK}]", fish=daemon.endpoint
    ) as window:

        async def connect(path: str, host: str | None = None, **headers: str) -> int:
            async with Browser(window.url, host) as browser:
                try:
                    async with browser.session.ws_connect(path, headers=headers):
                        return 101
                except aiohttp.WSServerHandshakeError as refusal:
                    return refusal.status

        assert await connect("/foxglove", Origin=LICHTBLICK) == 101
        assert await connect("/live", Origin=LICHTBLICK) == 403
        assert await connect("/foxglove", Origin="http://evil.example") == 403
        assert await connect("/foxglove", "fish.example") == 401


async def test_a_program_of_another_machine_reads_once_it_is_paired_until_it_is_revoked(
    window: WindowProcess,
) -> None:
    async with Browser(window.url, NETWORK_HOST) as browser:
        token = window.invite("watch").partition("#pair=")[2]
        await browser.post("/api/pair", {"token": token, "name": "viewer"})
        async with browser.session.ws_connect("/foxglove", protocols=PROTOCOLS) as sock:
            assert (await read_text(sock))["op"] == "serverInfo"
            window.ask("revoke", "viewer")
            while not sock.closed:
                await sock.receive()


def leaves(layout: Any) -> Iterator[str]:
    """Yield the panels of a layout."""
    if isinstance(layout, str):
        yield layout
    else:
        yield from leaves(layout["first"])
        yield from leaves(layout["second"])


def check_path(path: str, separator: str) -> None:
    """Check that telemetry has this field."""
    topic, _, field = path.partition(separator)
    assert not field or field in {entry.name for entry in fields_of(CHANNELS[topic])}, path


def test_each_panel_of_the_layout_is_set_up_and_each_of_its_paths_exists() -> None:
    layout = json.loads((LAYOUTS / "foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    for panel in panels.values():
        for path in panel.get("paths", []):
            check_path(path["value"], ".")
        if "topicPath" in panel:
            check_path(panel["topicPath"], ".")


def test_each_curve_of_the_layout_of_plotjuggler_exists() -> None:
    layout = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
    curves = layout.findall("tabbed_widget/Tab/Container/DockSplitter/DockArea/plot/curve")
    assert len(curves) == len(list(layout.iter("curve"))) > 5
    for curve in curves:
        check_path(curve.attrib["name"], "/")
