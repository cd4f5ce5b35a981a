"""Malformed HTTP requests and WebSocket messages to a window."""

import asyncio
import random
import struct
from collections.abc import Callable
from contextlib import suppress
from http.client import HTTPConnection

ANSWER_TIMEOUT_S = 10.0
LANES = 8
"""Number of attackers at a time."""
FRAMES_PER_CONNECTION = 20
PATHS = (
    "/", "/live", "/foxglove", "/camera", "/api/session", "/api/pair", "/api/unpair", "/api/fish",
    "/api/jobs", "/api/runs", "/api/fish/fish/drive", "/api/fish/fish/request",
    "/api/fish/fish/about/log", "/api/fish/fish/doctor",
    "/api/jobs/1/stop", "/api/runs/a/plot.png", "/vendor/manifest.json", "/metrics", "/none",
)  # fmt: skip
BODIES = (
    b"", b"{", b"[]", b"null", b"0", b'"x"', b"{}}", b'{"token":1}', b'{"token":"\xff"}',
    b'{"op":"set-controller","args":{"name":{}}}', b'{"op":"set-controller","args":[]}',
    b'{"op":"mark","args":{"text":"\\u0000"}}', b"[" * 8000, b'{"a":' * 2000, b"1" * 5000,
    b'{"fish":"fish","kind":"record","options":{"name":"../x"}}', b'{"take":1e999}',
    b'{"fish":"fish","kind":"fly"}', b"NaN", b"\x00\x01", b'{"keep":"yes"}', b"a" * 20_000,
)  # fmt: skip
HEADERS = (
    b"Content-Length: -1", b"Content-Length: 9\r\nContent-Length: 10", b"Content-Length: 99999999",
    b"Transfer-Encoding: chunked", b"Content-Length: 5\r\nTransfer-Encoding: chunked",
    b"Transfer-Encoding: chunked, identity", b"Host: evil.example", b"Host:", b"Host: a\r\nHost: b",
    b"X: " + b"y" * 9000, b"Expect: 100-continue", b"Upgrade: websocket\r\nConnection: Upgrade",
    b"Cookie: fishd_window=" + b"z" * 4000, b"Cookie: \xff=\xfe", b"Range: bytes=0-99999999999",
    b"Accept-Encoding: gzip;q=nan", b"Content-Encoding: gzip", b"Origin: null", b" folded: 1",
    b"NoColon", b"X-Client: \x00", b"If-None-Match: *", b"X-Forwarded-For: " + b"1," * 500,
    b"Authorization: Bearer \xff", b"Authorization: Bearer " + b"z" * 4000, b"Authorization:",
    b"Sec-WebSocket-Version: 0", b"Sec-WebSocket-Extensions: permessage-deflate; x=" + b"1" * 99,
)  # fmt: skip

Attack = Callable[[random.Random, int], bytes]


def garbage(chance: random.Random, port: int) -> bytes:
    """Return random bytes instead of a request."""
    return chance.randbytes(chance.randrange(1, 200))


def mutated(chance: random.Random, port: int) -> bytes:
    """Return a request with some bytes changed, removed or inserted."""
    request = bytearray(
        b"GET %s HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nAccept: */*\r\n\r\n"
        % (chance.choice(PATHS).encode(), port)
    )
    for _ in range(chance.randrange(1, 6)):
        place = chance.randrange(len(request))
        request[place : place + chance.randrange(2)] = chance.randbytes(chance.randrange(3))
    return bytes(request)


def wrong_header(chance: random.Random, port: int) -> bytes:
    """Return a request with a header that is malformed, doubled or too long."""
    lines = [
        b"%s %s HTTP/1.1" % (chance.choice((b"GET", b"POST", b"PUT", b"\xff")), _path(chance)),
        b"Host: 127.0.0.1:%d" % port,
        *chance.sample(HEADERS, chance.randrange(1, 4)),
    ]
    return b"\r\n".join(lines) + b"\r\n\r\n" + chance.choice(BODIES)


def wrong_body(chance: random.Random, port: int) -> bytes:
    """Return a request of the page's own origin whose body is malformed."""
    body = chance.choice(BODIES)
    head = (
        b"POST %s HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nOrigin: http://127.0.0.1:%d\r\n"
        b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n"
    )
    return head % (_path(chance), port, port, len(body)) + body


def wrong_frames(chance: random.Random, port: int) -> bytes:
    """Return a handshake, and WebSocket messages that mean nothing, the last one malformed."""
    head = (
        b"GET %s HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    path = chance.choice(
        (b"/live", b"/foxglove", b"/camera", b"/live?fish=none", b"/live?client=%ff")
    )
    frames = [
        _frame(0x81, chance.choice((*BODIES[:16], b'["seen",1]', b'{"op":"subscribe"}'))[:900])
        for _ in range(FRAMES_PER_CONNECTION - 1)
    ]
    first = chance.choice((0x83, 0xF1, 0xC1, 0x09, 0x88, 0x81, 0x80, 0x82))
    last = _frame(first, chance.randbytes(chance.randrange(2000)), masked=chance.random() < 0.5)
    return head % (path, port) + b"".join(frames) + last


ATTACKS: dict[str, tuple[Attack, int]] = {
    "no request at all": (garbage, 1),
    "a request with bytes changed": (mutated, 1),
    "headers: malformed, doubled, too long, smuggling": (wrong_header, 1),
    "bodies of the page's origin: malformed, nested, too long": (wrong_body, 1),
    "WebSocket messages and frames": (wrong_frames, FRAMES_PER_CONNECTION),
}
"""Attacks by their description, and the number of messages in one connection of each."""


def _path(chance: random.Random) -> bytes:
    path = chance.choice(PATHS)
    odd = (
        "",
        "",
        "",
        "?" + "a" * 9000,
        "/%2e%2e/%2e%2e/etc/passwd",
        "%00",
        "%zz",
        "//",
        "?since=x",
    )
    return (path + chance.choice(odd)).encode()


def _frame(first: int, payload: bytes, masked: bool = True) -> bytes:
    mask = 0x80 if masked else 0
    length = len(payload)
    head = bytes([first, mask | length]) if length < 126 else struct.pack(
        ">BBH", first, mask | 126, length
    )  # fmt: skip
    return head + bytes(4 * masked) + payload  # a mask of zeros changes nothing


class Mistake(Exception):
    """The window answered with status 500."""


async def send(payload: bytes, port: int) -> None:
    """Send the bytes, and read until the window closes the connection; raise `Mistake`."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    answer = b""
    try:
        writer.write(payload)
        async with asyncio.timeout(ANSWER_TIMEOUT_S):
            with suppress(ConnectionError, OSError):
                await writer.drain()
                writer.write_eof()
                while part := await reader.read(2**16):
                    answer = answer or part
    finally:
        writer.close()
    if answer[9:12] == b"500":
        raise Mistake(f"{payload[:300]!r} was answered with {answer[-300:]!r}")


async def attack(attacker: Attack, connections: int, seed: int, port: int) -> tuple[int, list[str]]:
    """Send malformed messages; return the number of connections left open, and the mistakes."""
    seeds = iter(range(connections))
    open_, mistakes = 0, list[str]()

    async def lane() -> None:
        nonlocal open_
        for number in seeds:
            try:
                await send(attacker(random.Random(f"{seed} {number}"), port), port)
            except TimeoutError:
                open_ += 1
            except Mistake as mistake:
                mistakes.append(str(mistake))

    await asyncio.gather(*(lane() for _ in range(LANES)))
    return open_, mistakes


def answers(port: int) -> bool:
    """Return whether the window answers a page."""
    connection = HTTPConnection("127.0.0.1", port, timeout=ANSWER_TIMEOUT_S)
    try:
        connection.request("GET", "/api/session")
        return connection.getresponse().status == 200
    except OSError:
        return False
    finally:
        connection.close()
