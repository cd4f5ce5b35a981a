"""What hostile or broken neighbours do to fishd's sockets; each ends by itself.

    python tools/attackers.py NAME TELEMETRY CONTROL SECONDS

Only addresses of this machine are attacked: tcp://127.0.0.1:PORT and ipc://PATH.
"""

import os
import random
import re
import socket
import sys
import time
from collections.abc import Callable

import zmq

LOCAL = re.compile(r"tcp://127\.0\.0\.1:[0-9]+|ipc://.*")
STATUS = b'{"v":1,"id":1,"op":"status"}'
# ZMTP 3.0, no security: a greeting, and the command READY of a SUB socket.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + b"\x00" + bytes(31)
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB"

Attack = Callable[[str, str, float], None]


def raw(address: str) -> socket.socket:
    """A plain connection."""
    if address.startswith("ipc://"):
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(address.removeprefix("ipc://"))
        return connection
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    return socket.create_connection((host, int(port)), 5.0)


def idle_connections(address: str, seconds: float) -> None:
    """1000 connections that say nothing."""
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
    """1000 idle connections to the telemetry socket."""
    idle_connections(telemetry, seconds)


def idle_control(telemetry: str, control: str, seconds: float) -> None:
    """1000 idle connections to the control socket."""
    idle_connections(control, seconds)


def subscriptions(telemetry: str, control: str, seconds: float) -> None:
    """A subscriber with 300 000 topics of 100 bytes, which leaves."""
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
    """Frames that announce 8 GB, sent as fast as they are taken, up to 2 GB."""
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


def silent_dealers(telemetry: str, control: str, seconds: float) -> None:
    """500 clients that ask for `status` all the time and never read an answer."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.set(zmq.MAX_SOCKETS, 1000)
    dealers = [context.socket(zmq.DEALER) for _ in range(500)]
    for dealer in dealers:
        dealer.set(zmq.RCVHWM, 1)
        dealer.connect(control)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for dealer in dealers:
            try:
                for _ in range(20):
                    dealer.send(STATUS, zmq.DONTWAIT)
            except zmq.Again:
                pass
    context.destroy(linger=0)


def long_ops(telemetry: str, control: str, seconds: float) -> None:
    """20 clients that read, and ask for ops with names of 16 and of 64 kB."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    dealers = [context.socket(zmq.DEALER) for _ in range(20)]
    for dealer in dealers:
        dealer.connect(control)
    longest = b'{"v":1,"id":1,"op":"' + b"x" * 65_000 + b'"}'
    long = b'{"v":1,"id":1,"op":"' + b"x" * 16_000 + b'"}'
    key = b'{"v":1,"id":1,"op":"set-controller","args":{"name":"swing","parameters":{"%b":1}}}'
    known = [long, key % (b"y" * 16_000), b'{"v":1,"id":1,"op":"statsu"}', longest]
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for dealer in dealers:
            try:
                for payload in known:
                    dealer.send(payload, zmq.DONTWAIT)
                while True:
                    dealer.recv(zmq.DONTWAIT)
            except zmq.Again:
                pass
    context.destroy(linger=0)


def fuzz(telemetry: str, control: str, seconds: float) -> None:
    """100 000 requests, damaged at random, from eight clients; at their own pace."""
    chance = random.Random(7)
    seeds = [
        STATUS,
        b'{"v":1,"id":"a","op":"set-controller","args":{"name":"swing","parameters":{"C":0.6}}}',
        b'{"v":1,"id":2,"op":"set-parameter","args":{"parameters":{"C":0.3}}}',
        b'{"v":1,"id":3,"op":"mark","args":{"text":"hello"}}',
        b'{"v":1,"id":4,"op":"sample-force","args":{"seconds":0.1}}',
        b'{"v":1,"id":5,"op":"config"}',
    ]
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    dealers = [context.socket(zmq.DEALER) for _ in range(8)]
    for dealer in dealers:
        dealer.connect(control)
    for number in range(100_000):
        payload = bytearray(chance.choice(seeds))
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
        dealer = dealers[number % 8]
        try:
            dealer.send(bytes(payload), zmq.DONTWAIT)
            while True:
                dealer.recv(zmq.DONTWAIT)
        except zmq.Again:
            pass
        if number % 50 == 0:
            time.sleep(50 * seconds / 100_000 * 0.8)
    context.destroy(linger=0)


def flood(telemetry: str, control: str, seconds: float) -> None:
    """10 000 requests a second, from 25 clients that read the answers."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    dealers = [context.socket(zmq.DEALER) for _ in range(25)]
    for dealer in dealers:
        dealer.connect(control)
    begun, sent = time.monotonic(), 0
    while (now := time.monotonic()) < begun + seconds:
        while sent < (now - begun) * 10_000:
            dealer = dealers[sent % 25]
            sent += 1
            try:
                dealer.send(STATUS, zmq.DONTWAIT)
                while True:
                    dealer.recv(zmq.DONTWAIT)
            except zmq.Again:
                pass
        time.sleep(0.001)
    context.destroy(linger=0)


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
