"""Attacks of hostile or broken clients on fishd's sockets; each ends by itself.

    python tests/rigs/attackers.py NAME TELEMETRY CONTROL SECONDS

Only addresses of this machine are attacked: tcp://127.0.0.1:PORT and ipc://PATH.
"""

import os
import random
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import zmq

LOCAL = re.compile(r"tcp://127\.0\.0\.1:[0-9]+|ipc://.*")
STATUS = b'{"v":2,"id":1,"op":"status"}'
# ZMTP 3.0, no security: a greeting, and the command READY of a SUB socket.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + b"\x00" + bytes(31)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"

Attack = Callable[[str, str, float], None]


def raw(address: str) -> socket.socket:
    """Return a plain connection."""
    if address.startswith("ipc://"):
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(address.removeprefix("ipc://"))
        return connection
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    return socket.create_connection((host, int(port)), 5.0)


def idle_connections(address: str, seconds: float) -> None:
    """Open 1000 connections that send nothing."""
    end = time.monotonic() + seconds
    held = []
    for _ in range(1000):
        try:
            held.append(raw(address))
        except OSError:
            time.sleep(0.01)
        if time.monotonic() > end:
            break
    time.sleep(max(0.0, end - time.monotonic()))


def idle_telemetry(telemetry: str, control: str, seconds: float) -> None:
    """Open 1000 idle connections to the telemetry socket."""
    idle_connections(telemetry, seconds)


def idle_control(telemetry: str, control: str, seconds: float) -> None:
    """Open 1000 idle connections to the control socket."""
    idle_connections(control, seconds)


def subscriptions(telemetry: str, control: str, seconds: float) -> None:
    """Subscribe to 300 000 topics of 100 bytes, and disconnect."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with context.socket(zmq.SUB) as subscriber:
        subscriber.set(zmq.LINGER, 0)
        subscriber.set(zmq.SNDHWM, 0)
        subscriber.connect(telemetry)
        end = time.monotonic() + seconds
        for number in range(300_000):
            subscriber.subscribe(b"%0100d" % (number * 7919 % 10**6))
            if time.monotonic() > end:
                break
        time.sleep(max(0.5, 0.5 * (end - time.monotonic())))
    context.destroy(linger=0)


def long_frame(telemetry: str, control: str, seconds: float) -> None:
    """Send frames that announce 8 GB as fast as possible, up to 2 GB."""
    end, sent = time.monotonic() + seconds, 0
    chunk = bytes(2**20)
    while time.monotonic() < end and sent < 2 * 2**30:
        try:
            with raw(telemetry) as connection:
                connection.settimeout(1.0)
                connection.sendall(GREETING + READY + b"\x02" + (8 * 2**30).to_bytes(8, "big"))
                while time.monotonic() < end and sent < 2 * 2**30:
                    connection.sendall(chunk)
                    sent += len(chunk)
        except OSError:
            time.sleep(0.05)


@contextmanager
def clients(control: str, count: int, **options: int) -> Iterator[list["zmq.Socket[bytes]"]]:
    """Return `count` clients of the control socket, with options of ZeroMQ by name."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.set(zmq.MAX_SOCKETS, count + 10)
    dealers = [context.socket(zmq.DEALER) for _ in range(count)]
    for dealer in dealers:
        for name, value in options.items():
            dealer.set(getattr(zmq, name), value)
        dealer.connect(control)
    yield dealers
    context.destroy(linger=0)


def send(dealer: "zmq.Socket[bytes]", payloads: list[bytes], read: bool = True) -> None:
    """Send as many of these as possible, and read all waiting answers."""
    with suppress(zmq.Again):
        for payload in payloads:
            dealer.send(payload, zmq.DONTWAIT)
        while read:
            dealer.recv(zmq.DONTWAIT)


def silent_dealers(telemetry: str, control: str, seconds: float) -> None:
    """Run 500 clients that request `status` all the time and never read an answer."""
    end = time.monotonic() + seconds
    with clients(control, 500, RCVHWM=1) as dealers:
        while time.monotonic() < end:
            for dealer in dealers:
                send(dealer, [STATUS] * 20, read=False)


def long_ops(telemetry: str, control: str, seconds: float) -> None:
    """Run 20 clients that read, and request operations with names of 16 and 64 kB."""
    longest = b'{"v":2,"id":1,"op":"' + b"x" * 65_000 + b'"}'
    long = b'{"v":2,"id":1,"op":"' + b"x" * 16_000 + b'"}'
    key = b'{"v":2,"id":1,"op":"set-controller","args":{"name":"swing","parameters":{"%b":1}}}'
    known = [long, key % (b"y" * 16_000), b'{"v":2,"id":1,"op":"statsu"}', longest]
    end = time.monotonic() + seconds
    with clients(control, 20) as dealers:
        while time.monotonic() < end:
            for dealer in dealers:
                send(dealer, known)


def fuzz(telemetry: str, control: str, seconds: float) -> None:
    """Send 100 000 randomly damaged requests from eight clients, as fast as answered."""
    chance = random.Random(7)
    seeds = [
        STATUS,
        b'{"v":2,"id":"a","op":"set-controller","args":{"name":"swing","parameters":{"C":0.6}}}',
        b'{"v":2,"id":2,"op":"set-parameter","args":{"parameters":{"C":0.3}}}',
        b'{"v":2,"id":3,"op":"mark","args":{"text":"hello"}}',
        b'{"v":2,"id":4,"op":"sample-force","args":{"seconds":0.1}}',
        b'{"v":2,"id":5,"op":"config"}',
    ]
    with clients(control, 8) as dealers:
        for number in range(100_000):
            send(dealers[number % 8], [damaged(chance.choice(seeds), chance)])
            if number % 50 == 0:
                time.sleep(50 * seconds / 100_000 * 0.8)


def damaged(request: bytes, chance: random.Random) -> bytes:
    """Return a request with up to three changes, deletions or insertions of bytes."""
    payload = bytearray(request)
    for _ in range(chance.randrange(4)):
        kind, place = chance.randrange(3), chance.randrange(len(payload))
        if kind == 0:
            payload[place] = chance.randrange(256)
        elif kind == 1:
            del payload[place : place + chance.randrange(8)]
        else:
            payload[place:place] = os.urandom(chance.randrange(20))
        if not payload:
            break
    return bytes(payload)


def flood(telemetry: str, control: str, seconds: float) -> None:
    """Send 10 000 requests per second from 25 clients that read the answers."""
    begun, sent = time.monotonic(), 0
    with clients(control, 25) as dealers:
        while (now := time.monotonic()) < begun + seconds:
            while sent < (now - begun) * 10_000:
                send(dealers[sent % 25], [STATUS])
                sent += 1
            time.sleep(0.001)


ATTACKS: dict[str, Attack] = {
    "idle-telemetry": idle_telemetry,
    "idle-control": idle_control,
    "subscriptions": subscriptions,
    "long-frame": long_frame,
    "silent-dealers": silent_dealers,
    "long-ops": long_ops,
    "fuzz": fuzz,
    "flood": flood,
}


def main(name: str, telemetry: str, control: str, seconds: str) -> None:
    """Attack fishd for a while."""
    if not all(LOCAL.fullmatch(address) for address in (telemetry, control)):
        raise SystemExit("only addresses of this machine are attacked")
    ATTACKS[name](telemetry, control, min(60.0, float(seconds)))


if __name__ == "__main__":
    main(*sys.argv[1:])
