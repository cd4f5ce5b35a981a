"""Requests under a lease and by hand, and what drives the fish after each of them."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from rigs.harness import Rig

from fishd.core.errors import Refused
from fishd.daemon.calibration_requests import CalibrationRequests
from fishd.daemon.requests import Operations


class Client:
    """Client of a daemon whose loop ticks only when the test runs it."""

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.rig = rig
        requests = CalibrationRequests(rig.loop, rig.clock, rig.config, folder)
        self._operations = Operations(rig.loop, rig.clock, requests, rig.config, [], False)

    async def ask(self, op: str, **args: Any) -> Any:
        return await self._operations.perform(op, args)

    async def take(self, name: str = "measure", **args: Any) -> str:
        lease: str = (await self.ask("take-lease", name=name, host="lab", pid=42, **args)).lease
        return lease

    async def expect_refusal(self, op: str, **args: Any) -> Refused:
        with pytest.raises(Refused) as refusal:
            await self.ask(op, **args)
        return refusal.value


Story = Callable[[Client], Awaitable[None]]


def run_story(folder: Path, story: Story, *overrides: str) -> Rig:
    rig = Rig(*overrides)
    client = Client(rig, folder)

    async def run() -> None:
        await story(client)

    asyncio.run(run())
    return rig


def test_a_lease_lasts_as_configured_or_as_asked_for_within_bounds(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        assert (await client.ask("take-lease", name="a")).seconds == 3.0
        assert (await client.ask("take-lease", name="b", take=True, seconds=9.0)).seconds == 9.0
        for s in (0.1, 61.0, "long"):
            refusal = await client.expect_refusal("take-lease", name="c", take=True, seconds=s)
            assert refusal.code == "bad-arguments"

    run_story(tmp_path, story, "control.lease=3.0")


def test_a_request_by_hand_takes_the_fish_and_the_answer_says_from_whom(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        for op, args in (("set-controller", {"name": "sine"}), ("stop", {})):
            lease = await client.take()
            state = await client.ask("set-controller", name="swing", lease=lease)
            assert (state.controller, state.previous_holder) == ("swing", None)
            client.rig.run_for(1.0)
            state = await client.ask(op, **args)
            holder = state.previous_holder
            assert (holder.name, holder.host, holder.pid) == ("measure", "lab", 42)
            assert holder.age == pytest.approx(1.0, abs=0.1)
            for change in ("set-controller", "stop", "renew-lease", "end-lease"):
                arguments = {"name": "swing"} if change == "set-controller" else {}
                refusal = await client.expect_refusal(change, lease=lease, **arguments)
                assert (refusal.code, "by hand" in str(refusal)) == ("no-lease", True)
            assert (await client.ask("status")).lease is None
        client.rig.run_for(10.0)
        assert client.rig.mode == "idle"

    run_story(tmp_path, story)


def test_by_hand_there_is_no_lease(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        state = await client.ask("set-controller", name="sine")
        assert state.previous_holder is None
        assert client.rig.run_for(20.0)[-1].controller == "sine"

    run_story(tmp_path, story)


def test_a_second_experiment_is_refused_unless_it_takes_the_fish(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        first = await client.take(seconds=10.0)
        await client.ask("set-controller", name="swing", lease=first)
        client.rig.run_for(1.0)
        refusal = await client.expect_refusal("take-lease", name="optimise")
        assert refusal.code == "leased"
        assert "measure (pid 42 on lab)" in str(refusal)
        assert client.rig.mode == "running"
        grant = await client.ask("take-lease", name="optimise", take=True)
        assert grant.previous_holder.name == "measure"
        assert client.rig.run_for(1.0)[-1].phi_c == 0.0
        refusal = await client.expect_refusal("set-controller", name="swing", lease=first)
        assert "optimise took the fish" in str(refusal)
        await client.ask("set-controller", name="swing", lease=grant.lease)
        assert (await client.ask("status")).lease.name == "optimise"
        state = await client.ask("end-lease", lease=grant.lease)
        assert (state.mode, state.previous_holder) == ("idle", None)
        events = client.rig.recorder.events
        kinds = [event.data["lease"] for event in events if "lease" in event.data]
        assert kinds == ["taken", "lost", "taken", "returned"]

    run_story(tmp_path, story)


def test_a_controller_still_loading_when_its_lease_ended_does_not_start(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        lease = await client.take()
        loading = asyncio.create_task(client.ask("set-controller", name="swing", lease=lease))
        await asyncio.sleep(0)  # starts loading it in a thread
        client.rig.loop.lease.end("a test")
        with pytest.raises(Refused, match="no longer holds the fish: a test"):
            await loading

    assert run_story(tmp_path, story).mode == "idle"


def test_a_tare_by_hand_is_refused_in_an_experiment_and_possible_within_it(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        client.rig.run_for(1.0)
        lease = await client.take(seconds=10.0)
        assert (await client.expect_refusal("tare", sample=1)).code == "leased"
        assert (await client.expect_refusal("tare", sample=1, lease=lease)).code == "no-samples"

    run_story(tmp_path, story)


def test_nothing_is_leased_while_a_fault_is_latched(tmp_path: Path) -> None:
    async def story(client: Client) -> None:
        client.rig.loop.estop("enough")
        assert (await client.expect_refusal("take-lease", name="measure")).code == "estop"

    run_story(tmp_path, story)
