"""Agents that say exactly what a test wants: bare sockets, as any language would have them."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import zmq

from rigs.harness import Rig
from rigs.processes import PATIENCE

Answer = dict[str, Any] | bytes | None


class ScriptedAgent:
    """A ROUTER that receives when it is told to, and sends anything."""

    def __init__(self, folder: Path) -> None:
        self.address = f"ipc://{folder}/agent"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.bind(self.address)
        self._peer = b""
        self.seen: list[dict[str, Any]] = []
        """Every message so far."""

    def close(self) -> None:
        self._context.destroy(linger=0)

    def next(self, seconds: float = PATIENCE) -> dict[str, Any]:
        """The next message; AssertionError when none comes."""
        assert self._socket.poll(int(seconds * 1e3)), f"nothing came within {seconds} s"
        self._peer, payload = self._socket.recv_multipart()
        message: dict[str, Any] = msgspec.json.decode(payload)
        self.seen.append(message)
        return message

    def drain(self) -> list[dict[str, Any]]:
        """Everything that has come by now."""
        begun = len(self.seen)
        while self._socket.poll(50):
            self.next()
        return self.seen[begun:]

    def send(self, *frames: Answer) -> None:
        parts = [f if isinstance(f, bytes) else msgspec.json.encode(f) for f in frames]
        self._socket.send_multipart([self._peer, *parts])

    def action(self, angle: float, **changes: Any) -> dict[str, Any]:
        """An action for the latest observation."""
        latest = next(m for m in reversed(self.seen) if m["kind"] == "observation")
        own = {"kind": "action", "v": 1, "session": latest["session"], "seq": latest["seq"]}
        return {**own, "phi_c": angle, **changes}

    def pause(self, seconds: float) -> dict[str, Any]:
        session = self.seen[-1]["session"]
        return {"kind": "pause", "v": 1, "session": session, "seconds": seconds}

    @contextmanager
    def answering(self, answer: Callable[[dict[str, Any]], Answer]) -> Iterator[None]:
        """Answer each observation in another thread; None keeps silent."""
        done = threading.Event()

        def answer_all() -> None:
            while not done.is_set():
                if not self._socket.poll(5):
                    continue
                message = self.next()
                reply = answer(message) if message["kind"] == "observation" else None
                if reply is not None:
                    self.send(reply)

        thread = threading.Thread(target=answer_all)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join(PATIENCE)


def connect(rig: Rig, agent: ScriptedAgent, **parameters: Any) -> dict[str, Any]:
    """Make `remote` active, and tick until its first observation has come; that."""
    before = {message["session"] for message in agent.seen}
    rig.start("remote", agent=agent.address, **parameters)
    for _ in range(100):
        rig.run()
        for message in agent.drain():
            if message["session"] not in before:
                return message
    raise AssertionError("no observation has come")


def swim(rig: Rig, agent: ScriptedAgent, angle: float = 0.2) -> None:
    """Tick until an action is in force."""
    with agent.answering(lambda seen: agent.action(angle)):
        while rig.run()[-1].phi_c == 0.0:
            pass


def reason(rig: Rig) -> str:
    """Of the fault, in words."""
    assert rig.loop.supervisor.reason
    return rig.loop.supervisor.reason.message
