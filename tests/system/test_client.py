"""The Python client, synchronous and asyncio, against the real daemon."""

import asyncio
import json
import math
import threading
from itertools import dropwhile, islice
from pathlib import Path

import pytest
import zmq
from rigs.processes import PATIENCE, Daemon

from fishd.client import AsyncFish, Fish, FishError, NoDaemon, Refused
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import ParameterError


def test_every_request_has_a_typed_answer(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.status().robot == "simulated"
        assert "square" in [info.name for info in fish.controllers()]
        state = fish.set_controller("square", frequency=2.0)
        assert (state.mode, state.parameters["frequency"]) == ("running", 2.0)
        assert fish.set_parameters(frequency=1.5).parameters["frequency"] == 1.5
        since = dropwhile(lambda tick: tick.seq < state.seq, fish.ticks())
        ticks = list(islice(since, 5))
        assert [tick.seq for tick in ticks] == list(range(ticks[0].seq, ticks[0].seq + 5))
        assert {tick.mode for tick in ticks} == {"running"}
        assert isinstance(ticks[0].alpha, float)
        assert fish.stop().mode == "idle"
        state = fish.estop("enough")
        assert state.reason is not None
        assert (state.mode, state.reason.message) == ("estop", "enough")
        assert fish.clear_fault().mode == "idle"


def test_events_arrive_as_they_happen(daemon: Daemon) -> None:
    seen: list[str] = []
    with (
        Fish(daemon.endpoint, timeout=PATIENCE) as listener,
        Fish(daemon.endpoint, timeout=PATIENCE) as sender,
    ):
        events = listener.events()
        marks = (event.message for event in events if event.kind == "mark")
        reader = threading.Thread(target=lambda: seen.append(next(marks)))
        reader.start()
        for _ in range(1000):  # until the subscription is through
            sender.mark("a wave in the tank")
            next(sender.ticks())
            if seen:
                break
        reader.join(PATIENCE)
    assert seen == ["a wave in the tank"]


def test_a_refusal_carries_its_code(daemon: Daemon) -> None:
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        with pytest.raises(Refused, match="did you mean 'swing'") as caught:
            fish.set_controller("swng")
        assert caught.value.code == "unknown-controller"
        with pytest.raises(ParameterError, match="C: nan is not a number that can be sent"):
            fish.set_controller("swing", C=math.nan)
        assert fish.status().mode == "idle"


async def test_nobody_at_the_endpoint_is_told_apart_from_a_refusal(tmp_path: Path) -> None:
    nobody = Fish(f"ipc://{tmp_path}/nobody")
    with nobody as fish, pytest.raises(NoDaemon, match="no process listens"):
        fish.status()
    silence = r"no answer within 0\.05 s"
    with Fish("tcp://127.0.0.1:9", timeout=0.05) as fish, pytest.raises(NoDaemon, match=silence):
        fish.status()
    with pytest.raises(NoDaemon, match=silence):
        async with AsyncFish("tcp://127.0.0.1:9", timeout=0.05) as fish:
            await fish.status()


def test_telemetry_that_ends_is_noticed(own_daemon: Daemon) -> None:
    with Fish(own_daemon.endpoint, timeout=5.0) as fish:
        ticks = fish.ticks()
        next(ticks)
        own_daemon.end()
        with pytest.raises(NoDaemon, match="no telemetry within 5 s"):
            list(ticks)


async def test_asyncio_programs_get_the_same(daemon: Daemon) -> None:
    async with AsyncFish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert (await fish.set_controller("swing", C=0.5)).controller == "swing"
        assert (await fish.set_parameters(C=0.7)).parameters["C"] == 0.7
        seen = []
        async for tick in fish.ticks():
            seen.append(tick.seq)
            if len(seen) == 5:
                break
        assert seen == list(range(seen[0], seen[0] + 5))
        assert (await fish.status()).controller == "swing"
        assert "hold" in [info.name for info in await fish.controllers()]
        with pytest.raises(Refused, match="did you mean 'swing'"):
            await fish.set_controller("swung")
        assert (await fish.estop()).mode == "estop"
        assert (await fish.clear_fault()).mode == "idle"
        assert (await fish.mark("done")).mode == "idle"
        assert (await fish.stop()).mode == "idle"


def test_text_that_is_not_utf8_is_refused_but_never_stops_an_emergency_stop() -> None:
    connection = Fish("ipc:///nowhere")
    for calibration in ("\udcff", ServoCalibration(date="\udcff")):
        with pytest.raises(ParameterError, match=r"calibrate-servo: '\?' is not a text in UTF-8"):
            connection.request("calibrate-servo", {"calibration": calibration})
    assert b"stop ?" in connection.request("estop", {"message": "stop \udcff"})[1]


def test_a_command_whose_gateway_is_gone_fails_at_once_and_is_not_repeated(tmp_path: Path) -> None:
    """The first gateway takes the command and is gone; the next one gets only what follows."""
    endpoint = f"ipc://{tmp_path}/control"
    operations = []
    gateways = threading.Semaphore(0)

    def serve_two_gateways() -> None:
        for _ in range(2):
            with zmq.Context() as context, context.socket(zmq.ROUTER) as gateway:
                gateway.linger = 0
                gateway.bind(endpoint)
                gateways.release()
                assert gateway.poll(PATIENCE * 1e3)
                operations.append(json.loads(gateway.recv_multipart()[-1])["op"])

    server = threading.Thread(target=serve_two_gateways)
    server.start()
    assert gateways.acquire(timeout=PATIENCE)
    with Fish(endpoint, timeout=1e6) as fish:
        with pytest.raises(NoDaemon, match="before the answer to mark: it is not known whether"):
            fish.mark("once")
        assert gateways.acquire(timeout=PATIENCE)
        fish.timeout = 1.0
        with pytest.raises(NoDaemon, match="no answer within 1 s"):
            fish.status()
    server.join()
    assert operations == ["mark", "status"]


async def test_an_asyncio_client_closes_while_a_request_has_no_answer(tmp_path: Path) -> None:
    """The request ends with an error, not after its timeout."""
    endpoint = f"ipc://{tmp_path}/control"

    with zmq.Context() as context, context.socket(zmq.ROUTER) as silent:
        silent.linger = 0
        silent.bind(endpoint)
        fish = AsyncFish(endpoint, timeout=1e6)
        request = asyncio.create_task(fish.status())
        assert await asyncio.to_thread(silent.poll, PATIENCE * 1e3)
        fish.close()
        with pytest.raises(FishError, match="the client was closed during a request"):
            await request
