"""Attacks on the emergency stop of a window, with true connections, mounts and locks."""

import asyncio
import ctypes
import fcntl
import json
import os
import socket
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import msgspec

SLOW_BODIES = 70
"""Number of connections that send no body."""
HELD_BODIES = 64
"""Number of connections that send no body while others come."""
ARRIVALS_PER_S = 22
BARE_CONNECTIONS_PER_S = 1000
BARE_CONNECTIONS = f"{BARE_CONNECTIONS_PER_S} bare connections a second"
"""Description of the attack with these."""
MAX_BARE_CONNECTIONS = 600
"""Number of bare connections that are open at a time."""
HISTORIES = 60
FLOODS = 10
"""Number of WebSockets that send as many messages as the window takes."""
PRESS_TIMEOUT_S = 20.0
FULL_BYTES = 256 * 2**10
"""Size of a disk that is filled [bytes]."""
_FRAME = b'\x81\x8a\0\0\0\0["seen",1]'
"""Message of a page; a mask of zeros changes nothing."""
_HANDSHAKE = (
    "Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
)  # fmt: skip


class Target(NamedTuple):
    """Window, as a browser at one address of this machine reaches it."""

    address: str
    port: int
    cookie: str = ""
    """Token of a paired device; empty for a browser of this machine."""

    def request(self, method: str, path: str, *headers: str, body: bytes = b"") -> bytes:
        """Return a request as a browser sends it."""
        place = f"{self.address}:{self.port}"
        lines = [f"{method} {path} HTTP/1.1", f"Host: {place}", f"Origin: http://{place}", *headers]
        if self.cookie:
            lines.append(f"Cookie: fishd_window={self.cookie}")
        if method == "POST":
            lines.append("Content-Type: application/json")
            if not any(header.startswith(("Content-Length", "Transfer")) for header in headers):
                lines.append(f"Content-Length: {len(body)}")
        return "\r\n".join([*lines, "", ""]).encode() + body

    async def exchange(self, payload: bytes) -> bytes:
        """Send a request over a new connection, as from the same address; return the answer."""
        reader, writer = await self.connect()
        try:
            writer.write(payload)
            return await reader.read()
        finally:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Open a connection from the address of this target to that address."""
        source = (self.address, 0)
        return await asyncio.open_connection(self.address, self.port, local_addr=source)


async def press(target: Target) -> float | None:
    """Press the E-stop once; return the time until its answer [s], None if it is refused."""
    start = time.monotonic()
    try:
        async with asyncio.timeout(PRESS_TIMEOUT_S):
            payload = target.request("POST", "/api/fish/fish/estop", body=b"{}")
            answer = await target.exchange(payload)
    except (OSError, TimeoutError):
        return None
    return time.monotonic() - start if answer[9:12] == b"200" else None


async def pair(address: str, port: int, token: str) -> Target:
    """Pair this machine at an address of its network as a device."""
    target = Target(address, port)
    body = json.dumps({"token": token, "name": "tablet"}).encode()
    answer = await target.exchange(target.request("POST", "/api/pair", body=body))
    cookie = answer.partition(b"fishd_window=")[2].partition(b";")[0].decode()
    assert cookie, answer
    return target._replace(cookie=cookie)


def own_address() -> str:
    """Return an address of this machine in its network; one of loopback if it has none."""
    for place in ("192.0.2.1", "198.51.100.1"):  # the network, and that of a test process
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
            probe.connect((place, 9))  # sends nothing, but chooses the address
            return str(probe.getsockname()[0])
    return "127.0.0.1"


# Attacks over the network: each opens its connections again, until it is cancelled.

Attack = Callable[[Target, Callable[[], None]], Awaitable[object]]
"""Attack on a window, and a function that it calls after each request."""


async def slow_bodies(target: Target, sent: Callable[[], None]) -> None:
    """Keep connections whose body does not come."""
    await asyncio.gather(*(_repeat(_send_head, target, sent) for _ in range(SLOW_BODIES)))


async def arriving_bodies(target: Target, sent: Callable[[], None]) -> None:
    """Keep connections whose body does not come, and open new ones all the time."""
    async with asyncio.TaskGroup() as group:
        for _ in range(HELD_BODIES):
            group.create_task(_repeat(_send_head, target, sent))
        while True:
            group.create_task(_send_head(target, sent))
            await asyncio.sleep(1.0 / ARRIVALS_PER_S)


async def histories(target: Target, sent: Callable[[], None]) -> None:
    """Open pages, which get the history, again and again."""
    await asyncio.gather(*(_repeat(_read_history, target, sent) for _ in range(HISTORIES)))


async def frames(target: Target, sent: Callable[[], None]) -> None:
    """Send small messages over WebSockets as fast as possible."""
    await asyncio.gather(*(_repeat(_flood, target, sent) for _ in range(FLOODS)))


async def bare_connections(target: Target, sent: Callable[[], None]) -> None:
    """Open connections that send nothing."""
    loop, opened = asyncio.get_running_loop(), deque[socket.socket]()
    start, count = loop.time(), 0
    try:
        while True:
            while count < (loop.time() - start) * BARE_CONNECTIONS_PER_S:
                count += 1
                client = socket.socket()
                opened.append(client)
                client.setblocking(False)
                client.bind((target.address, 0))
                client.connect_ex((target.address, target.port))
                sent()
                if len(opened) > MAX_BARE_CONNECTIONS:
                    opened.popleft().close()
            await asyncio.sleep(0.005)
    finally:
        for client in opened:
            client.close()


NETWORK_ATTACKS: dict[str, Attack] = {
    f"{SLOW_BODIES} connections without their body": slow_bodies,
    f"{HELD_BODIES} of these, and {ARRIVALS_PER_S} new ones a second": arriving_bodies,
    BARE_CONNECTIONS: bare_connections,
    f"{HISTORIES} pages that open at a time": histories,
    f"{FLOODS} WebSockets full of messages": frames,
}
"""Attacks over the network by their description."""


async def _repeat(attack: Attack, target: Target, sent: Callable[[], None]) -> None:
    while True:
        await attack(target, sent)
        await asyncio.sleep(0)


async def _send_head(target: Target, sent: Callable[[], None]) -> None:
    with suppress(OSError):
        reader, writer = await target.connect()
        try:
            writer.write(target.request("POST", "/api/pair", "Content-Length: 9"))
            sent()
            await reader.read()  # until the window ends the connection
        finally:
            writer.transport.abort()


async def _read_history(target: Target, sent: Callable[[], None]) -> None:
    with suppress(OSError):
        reader, writer = await target.connect()
        try:
            writer.write(target.request("GET", "/live", *_HANDSHAKE))
            sent()
            with suppress(asyncio.IncompleteReadError):
                while b'["history",' not in await reader.readexactly(2**10):
                    pass
        finally:
            writer.transport.abort()


async def _flood(target: Target, sent: Callable[[], None]) -> None:
    with suppress(OSError):
        reader, writer = await target.connect()
        reading = asyncio.create_task(_discard(reader))
        try:
            writer.write(target.request("GET", "/live", *_HANDSHAKE))
            while not reading.done():
                writer.write(200 * _FRAME)
                sent()
                await writer.drain()
        finally:
            reading.cancel()
            writer.transport.abort()  # close() would wait until all is sent
            await asyncio.sleep(0)


async def _discard(reader: asyncio.StreamReader) -> None:
    with suppress(OSError):
        while await reader.read(2**16):
            pass


# Troubles of the disk with the state folder of the window.


@contextmanager
def mounted(folder: Path) -> Iterator[None]:
    """Mount a small file system in memory at a folder; raise OSError where that is forbidden."""
    _mount("tmpfs", folder, "tmpfs", f"size={FULL_BYTES},mode=700")
    try:
        yield
    finally:
        _unmount(folder)


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """Fill the file system that is mounted at a folder."""
    assert folder.is_mount()  # never the disk of the machine
    filling = folder / "filling"
    with suppress(OSError), filling.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    try:
        yield
    finally:
        filling.unlink()


@contextmanager
def stalled(folder: Path) -> Iterator[None]:
    """Mount a file system at a folder that answers no request until the context ends."""
    device = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
    try:
        _mount("stalled", folder, "fuse", f"fd={device},rootmode=40000,user_id=0,group_id=0")
        try:
            yield
        finally:
            _unmount(folder)
    finally:
        os.close(device)  # ends all requests that wait


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of the paired devices, as another process does."""
    with (folder / "lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def damaged(folder: Path) -> Iterator[None]:
    """Damage the file of the paired devices."""
    path = folder / "devices.json"
    content = path.read_bytes()
    path.write_text("{")
    try:
        yield
    finally:
        path.write_bytes(content)


DISK_TROUBLES: dict[str, Callable[[Path], AbstractContextManager[None]]] = {
    "a damaged file of the devices": damaged,
    "the lock of the devices is held": locked,
    "a full disk": full,
    "a disk that stalls": stalled,
}
"""Troubles of the state folder by their description, in an order in which all can be tried."""


def unsee(folder: Path) -> None:
    """Let the file say that all devices were seen long ago, so that the window updates it."""
    path = folder / "devices.json"
    content = msgspec.json.decode(path.read_bytes())
    for device in content["devices"]:
        device["seen"] = 0.0
    path.write_bytes(msgspec.json.encode(content))


def _mount(source: str, folder: Path, kind: str, options: str) -> None:
    words = [word.encode() for word in (source, os.fspath(folder), kind)]
    if ctypes.CDLL(None, use_errno=True).mount(*words, 0, options.encode()):
        raise OSError(ctypes.get_errno(), "cannot be mounted", os.fspath(folder))


def _unmount(folder: Path) -> None:
    detach = 2  # MNT_DETACH: also while it is used
    ctypes.CDLL(None).umount2(os.fspath(folder).encode(), detach)
