"""The server of pages: its files, the pictures of a camera, its clients, and their limits."""

import asyncio
import re
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import aiohttp
import pytest
from aiohttp import web
from rigs.page_server import PageServer

from fishd.core.errors import StartupError
from fishd.window import places, web_server

FACTS = "streaming"


@asynccontextmanager
async def run_server() -> AsyncIterator[tuple[PageServer, aiohttp.ClientSession]]:
    async with PageServer("127.0.0.1", 0) as server, aiohttp.ClientSession(server.url) as session:
        yield server, session


async def test_the_page_and_its_files_are_given_and_need_nothing_from_elsewhere() -> None:
    async with run_server() as (_, session):
        for path, kind in (("/", "text/html"), ("/app.js", "text/javascript"),
                           ("/app.css", "text/css")):  # fmt: skip
            async with session.get(path) as response:
                assert (response.status, response.content_type) == (200, kind)
                assert "default-src 'none'" in response.headers["Content-Security-Policy"]
                assert not re.search("https?://", await response.text())


async def receive_picture(sock: aiohttp.ClientWebSocketResponse) -> tuple[str, bytes]:
    return await sock.receive_str(), await sock.receive_bytes()


async def test_a_page_gets_pictures_with_their_facts() -> None:
    async with run_server() as (server, session):
        server.show(FACTS)
        server.show(("tail", b"first"))
        async with session.ws_connect("/live") as sock:
            assert await sock.receive_str() == FACTS
            assert await receive_picture(sock) == ("tail", b"first")
            server.show("lost")
            assert await sock.receive_str() == "lost"


async def test_a_page_gets_the_newest_picture_once_it_has_drawn_the_last_one() -> None:
    async with run_server() as (server, session), session.ws_connect("/live") as sock:
        while not server.viewers:
            await asyncio.sleep(0.01)
        for number in range(200):
            server.show((str(number), bytes([number])))
            if number == 0:
                assert await receive_picture(sock) == ("0", b"\x00")
        server.show(FACTS)
        assert await sock.receive_str() == FACTS  # does not wait for the page
        await sock.send_str('["drawn"]')
        assert await receive_picture(sock) == ("199", b"\xc7")


@pytest.mark.parametrize("method", ["POST", "DELETE"])
@pytest.mark.parametrize("path", ["/", "/live"])
async def test_nothing_can_be_changed(method: str, path: str) -> None:
    async with (
        run_server() as (_, session),
        session.request(method, path, data=b"x") as response,
    ):
        assert response.status == 405


@pytest.mark.parametrize("path", ["/none", "/%2e%2e/server.py"])
async def test_no_other_file_is_given(path: str) -> None:
    async with run_server() as (_, session), session.get(path) as response:
        assert response.status == 404
        assert "nosniff" in response.headers["X-Content-Type-Options"]


@pytest.mark.parametrize(
    ("host", "status"),
    [("localhost", 200), ("[::1]:9876", 200), ("192.168.0.7", 200), ("evil", 403)],
)
async def test_who_asks_by_the_name_of_another_machine_is_refused(host: str, status: int) -> None:
    async with (
        run_server() as (_, session),
        session.get("/", headers={"Host": host}) as response,
    ):
        assert response.status == status


@pytest.mark.realtime
async def test_an_end_does_not_wait_for_pages_that_never_read_or_connections_that_never_ask() -> (
    None
):
    async with asyncio.timeout(20.0), PageServer("127.0.0.1", 0) as server:
        host, port = "127.0.0.1", int(server.url.rsplit(":", 1)[1].strip("/"))
        deaf = socket.socket()
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.setblocking(False)
        loop = asyncio.get_running_loop()
        await loop.sock_connect(deaf, (host, port))
        await loop.sock_sendall(deaf, UPGRADE.replace(b"HOST", f"{host}:{port}".encode()))
        slow = [await asyncio.open_connection(host, port) for _ in range(4)]
        for (_, writer), sent in zip(slow, HALF_ASKED, strict=True):
            writer.write(sent)
            await writer.drain()
        assert (await loop.sock_recv(deaf, 12)).endswith(b" 101")
        server.show(("", bytes(20 * 2**20)))  # more than all buffers hold
        await asyncio.sleep(0.1)
        ending = time.monotonic()
    ended = time.monotonic() - ending
    deaf.close()
    for _, writer in slow:
        writer.close()
    assert ended < 1.5


UPGRADE = (
    b"GET /live HTTP/1.1\r\nHost: HOST\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)
HALF_ASKED = (
    b"",
    b"GET / HT",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ",
    b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nx",
)


@asynccontextmanager
async def neighbour(server: PageServer) -> AsyncIterator[aiohttp.ClientSession]:
    """Yield a client with another address."""
    connector = aiohttp.TCPConnector(local_addr=("127.0.0.2", 0))
    async with aiohttp.ClientSession(server.url, connector=connector) as session:
        yield session


async def test_more_pages_than_are_served_are_refused_and_let_in_once_another_is_gone() -> None:
    async with run_server() as (server, session), neighbour(server) as second_session:
        most = web_server.MAX_VIEWERS_PER_ADDRESS
        socks = [await session.ws_connect("/live") for _ in range(most)]
        await check_refused(session)
        while len(socks) < web_server.MAX_VIEWERS:
            socks.append(await second_session.ws_connect("/live"))
        await check_refused(second_session)
        await socks[0].close()
        while True:
            try:
                sock = await session.ws_connect("/live")
                break
            except aiohttp.WSServerHandshakeError:
                await asyncio.sleep(0.02)
        server.show("again")
        assert await sock.receive_str() == "again"
        for opened in (*socks, sock):
            await opened.close()


async def check_refused(session: aiohttp.ClientSession) -> None:
    with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
        await session.ws_connect("/live")
    assert refusal.value.status == 503


async def connect(
    server: PageServer, sent: bytes = b""
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    port = int(server.url.rsplit(":", 1)[1].strip("/"))
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(sent)
    return reader, writer


COMPLETE_REQUEST = b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: keep-alive\r\n\r\n"


@pytest.mark.parametrize("sent", [HALF_ASKED[0], HALF_ASKED[3], COMPLETE_REQUEST])
async def test_no_client_keeps_the_page_from_others(
    sent: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web_server, "REQUEST_TIMEOUT_S", 120.0)

    async with run_server() as (server, session):
        clients = [await connect(server, sent) for _ in range(100)]
        ends = [asyncio.create_task(reader.read()) for reader, _ in clients]
        try:
            while sum(end.done() for end in ends) < 100 - places.PLACES:
                await asyncio.sleep(0.01)  # until the server has seen them all
            async with neighbour(server) as second_session, asyncio.timeout(60.0):
                for client in (session, second_session):
                    async with client.get("/") as response:
                        assert response.status == 200
        finally:
            for _, writer in clients:
                writer.close()
            await asyncio.gather(*ends, return_exceptions=True)


async def test_a_connection_that_sends_nothing_costs_no_handler(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    create, created = web.Server.__call__, 0

    def count(server: web.Server) -> web.RequestHandler:
        nonlocal created
        created += 1
        return create(server)

    monkeypatch.setattr(web.Server, "__call__", count)

    async with run_server() as (server, session):
        silent = [await connect(server) for _ in range(50)]
        async with session.get("/") as response:  # is accepted after them
            assert response.status == 200
        assert created == 1
        for _, writer in silent:
            writer.close()


@pytest.mark.parametrize("sent", HALF_ASKED)
async def test_half_a_request_is_ended_soon(sent: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "REQUEST_TIMEOUT_S", 0.3)

    async with run_server() as (server, _):
        reader, writer = await connect(server, sent)
        await reader.read()
        writer.close()


async def test_a_port_that_is_taken_is_one_line() -> None:
    async with run_server() as (server, _):
        port = int(server.url.rsplit(":", 1)[1].strip("/"))
        with pytest.raises(StartupError, match=r"cannot serve a page at .*; name another one with"):
            async with PageServer("127.0.0.1", port):
                pass
