"""Scripted agents on plain sockets."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import zmq

from fishd.controllers.remote.controller import Remote
from fishd.core.clock import Slot
from fishd.core.signals import Tick
from rigs.harness import Rig
from rigs.processes import PATIENCE, wait_until

Answer = dict[str, Any] | bytes | None


class ScriptedAgent:
    """ROUTER socket that receives on request and sends anything."""

    def __init__(self, folder: Path) -> None:
        self.address = f"ipc://{folder}/agent"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.bind(self.address)
        self._peer = b""
        self.seen: list[dict[str, Any]] = []
        """All received messages."""

    def close(self) -> None:
        self._context.destroy(linger=0)

    def next(self, seconds: float = PATIENCE) -> dict[str, Any]:
        """Return the next message; raises AssertionError without one."""
        assert self._socket.poll(int(seconds * 1e3)), f"nothing came within {seconds} s"
        self._peer, payload = self._socket.recv_multipart()
        message: dict[str, Any] = msgspec.json.decode(payload)
        self.seen.append(message)
        return message

    def has_message(self) -> bool:
        return bool(self._socket.poll(0))

    def drain(self) -> list[dict[str, Any]]:
        """Return all waiting messages."""
        begun = len(self.seen)
        while self._socket.poll(50):
            self.next()
        return self.seen[begun:]

    def send(self, *frames: Answer) -> None:
        parts = [f if isinstance(f, bytes) else msgspec.json.encode(f) for f in frames]
        self._socket.send_multipart([self._peer, *parts])

    def action(self, angle: float, **changes: Any) -> dict[str, Any]:
        """Return an action for the latest observation."""
        latest = next(m for m in reversed(self.seen) if m["kind"] == "observation")
        own = {"kind": "action", "v": 2, "session": latest["session"], "seq": latest["seq"]}
        return {**own, "phi_c": angle, **changes}

    def pause(self, seconds: float) -> dict[str, Any]:
        session = self.seen[-1]["session"]
        return {"kind": "pause", "v": 2, "session": session, "seconds": seconds}

    @contextmanager
    def answering(self, answer: Callable[[dict[str, Any]], Answer]) -> Iterator[None]:
        """Answer each observation in another thread; None does not answer."""
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


def remote(rig: Rig) -> Remote:
    """Return the active controller."""
    controller = rig.loop.active.controller
    assert isinstance(controller, Remote), rig.reason
    return controller


def connect(rig: Rig, agent: ScriptedAgent, **parameters: Any) -> dict[str, Any]:
    """Activate `remote`, and return its first observation."""
    before = {message["session"] for message in agent.seen}
    rig.start("remote", agent=agent.address, **parameters)
    wait_for_connection(rig)
    rig.run()
    while (message := agent.next())["session"] in before:
        pass
    return message


def wait_for_connection(rig: Rig) -> None:
    """Wait until the next tick can send its observation."""
    wait_until(lambda: remote(rig)._wire.state()[0])


def wait_for_message(rig: Rig) -> None:
    """Wait until a message of the agent has arrived for the next tick."""
    wait_until(lambda: remote(rig)._wire.state()[1])


def run_answered_tick(rig: Rig, agent: ScriptedAgent, angle: float, **changes: Any) -> Tick:
    """Run one tick, with its answer before its deadline starts.

    changes: changes of the action in the answer
    """
    controller, deadline = remote(rig), rig.index * rig.config.tick
    before = controller._seq
    rig.clock.now = max(rig.clock.now, deadline)
    turn = rig.loop.observe(Slot(rig.index, deadline, rig.clock.now, 0))
    rig.index += 1
    wait_until(lambda: controller.ready(turn.observation) or controller._seq > before)
    while agent.next().get("seq") != controller._seq:
        pass
    agent.send(agent.action(angle, **changes))
    wait_for_message(rig)
    rig.loop.act(turn)
    return rig.recorder.ticks[-1]


def swim(rig: Rig, agent: ScriptedAgent, angle: float = 0.2) -> None:
    """Run one tick with an active action."""
    assert run_answered_tick(rig, agent, angle).phi_c == angle


def reason(rig: Rig) -> str:
    """Return the message of the fault."""
    assert rig.loop.supervisor.reason
    return rig.loop.supervisor.reason.message
