"""A client that was itself held up past its time-out takes the answer that has come meanwhile."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq
from rigs.processes import PATIENCE, wait_until

from fishd.camera.settings import CameraSettings, SimulatedSettings
from fishd.core import protocol
from fishd.core.protocol import State

TIMEOUT = 1.0
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
import sys, zmq
from fishd.camera.requests import CameraRequests

with zmq.Context() as context:
    try:
        print(CameraRequests(sys.argv[1], context, float(sys.argv[2])).settings().source)
    finally:
        context.destroy(linger=0)
"""
LONG = "x" * 1_000_000
"""Makes an answer take a moment to be read, once the client goes on."""
IDLE = State(1, "idle", None, "hold", {"text": LONG})
CAMERA_SETTINGS = CameraSettings(simulated=SimulatedSettings(fishd=LONG))


def state_of(pid: int) -> str:
    """Of a process, as /proc has it: T where it is stopped."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.mark.parametrize(
    ("program", "answer", "said"),
    [
        (SYNCHRONOUS, IDLE, "idle"),
        (ASYNCHRONOUS, IDLE, "idle"),
        (CAMERA, CAMERA_SETTINGS, CAMERA_SETTINGS.source),
    ],
    ids=["Fish", "AsyncFish", "CameraRequests"],
)
def test_an_answer_that_nobody_has_read_yet_is_no_silence(
    tmp_path: Path, program: str, answer: object, said: str
) -> None:
    endpoint = f"ipc://{tmp_path}/control"
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        server.bind(endpoint)
        command = [sys.executable, "-c", program, endpoint, str(TIMEOUT)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as client:
            assert server.poll(PATIENCE * 1e3)
            *envelope, payload = server.recv_multipart()
            os.kill(client.pid, signal.SIGSTOP)
            wait_until(lambda: state_of(client.pid) == "T")
            request = protocol.decode_request(payload)
            server.send_multipart([*envelope, protocol.success(request.id, answer)])
            time.sleep(TIMEOUT + 0.2)  # longer than the client means to wait
            os.kill(client.pid, signal.SIGCONT)
            out, err = client.communicate(timeout=PATIENCE)
    assert (out, err) == (f"{said}\n", "")
