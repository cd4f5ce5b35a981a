"""A client that was delayed beyond its timeout uses the answer that has arrived meanwhile."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import zmq
from rigs.processes import PATIENCE, is_stopped, wait_until

from fishd.camera.settings import CameraSettings, SimulatedSettings
from fishd.core import protocol
from fishd.core.protocol import State

TIMEOUT = 3.0
"""Timeout of a client, longer than a busy machine takes to stop it [s]."""
SYNCHRONOUS = """
import sys
from fishd.client import Fish

with Fish(sys.argv[1], timeout=float(sys.argv[2])) as fish:
    print(fish.stop().mode)
"""
ASYNCHRONOUS = """
import asyncio, sys
from fishd.client import AsyncFish

async def ask():
    async with AsyncFish(sys.argv[1], timeout=float(sys.argv[2])) as fish:
        print((await fish.stop()).mode)

asyncio.run(ask())
"""
CAMERA = """
import sys
from fishd.camera.requests import CameraRequests

with CameraRequests(sys.argv[1], float(sys.argv[2])) as camera:
    print(camera.settings().source)
"""
LONG_TEXT = "x" * 1_000_000
"""Text that takes a moment to be read, after the client continues."""
IDLE = State(1, "idle", None, "hold", {"text": LONG_TEXT})
CAMERA_SETTINGS = CameraSettings(simulated=SimulatedSettings(fishd=LONG_TEXT))


CLIENTS = (
    (SYNCHRONOUS, IDLE, "idle"),
    (ASYNCHRONOUS, IDLE, "idle"),
    (CAMERA, CAMERA_SETTINGS, CAMERA_SETTINGS.source),
)
"""Programs, the answer to each, and its output."""


def test_an_answer_that_nobody_has_read_yet_is_no_silence(tmp_path: Path) -> None:
    with ExitStack() as stack:
        context, poller = stack.enter_context(zmq.Context()), zmq.Poller()
        clients = {}
        for number, (program, answer, words) in enumerate(CLIENTS):
            endpoint = f"ipc://{tmp_path}/{number}"
            server = stack.enter_context(context.socket(zmq.ROUTER))
            server.bind(endpoint)
            poller.register(server, zmq.POLLIN)
            command = [sys.executable, "-c", program, endpoint, str(TIMEOUT)]
            pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
            client = subprocess.Popen(command, **pipes, text=True)
            clients[server] = stack.enter_context(client), answer, words
        for _ in clients:  # in the order of their requests
            ((server, _), *_) = poller.poll(PATIENCE * 1e3)
            client, answer, _ = clients[server]
            *envelope, payload = server.recv_multipart()
            os.kill(client.pid, signal.SIGSTOP)
            wait_until(lambda pid=client.pid: is_stopped(pid))
            request = protocol.decode_request(payload)
            server.send_multipart([*envelope, protocol.success(request.id, answer)])
        time.sleep(TIMEOUT + 0.2)  # longer than the timeout of a client
        for client, _, words in clients.values():
            os.kill(client.pid, signal.SIGCONT)
            assert client.communicate(timeout=PATIENCE) == (f"{words}\n", "")
