"""Leases of servo calibrations that are not saved; fishd undoes them when the lease ends."""

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import asdict
from rigs.lockstep_rig import LockstepRig, lockstep_rig
from rigs.processes import PATIENCE

from fishd.assembly import state_folder
from fishd.controllers import registry
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import Refused
from fishd.core.protocol import DEFAULT_LEASE_S
from fishd.daemon.calibration_requests import CalibrationRequests
from fishd.daemon.requests import Operations
from fishd.hardware.calibration_files import CalibrationFolder

WIDE_LIMITS = ServoCalibration(trim=30.0, lowest=-3.0, highest=3.0)


NARROW_LIMITS = ServoCalibration(trim=30.0)


class Client:
    """Client of a daemon whose loop ticks only when the test runs it."""

    def __init__(self, rig: LockstepRig) -> None:
        self.rig = rig
        requests = CalibrationRequests(rig.loop, rig.clock, rig.config, state_folder(rig.config))
        self._operations = Operations(rig.loop, rig.clock, requests, rig.config, [], False)

    async def ask(self, op: str, **args: Any) -> Any:
        return await self._operations.perform(op, args)

    async def calibrate(
        self, calibration: ServoCalibration, *, save: bool = False, lease: str | None = None
    ) -> Any:
        values = asdict(calibration)
        return await self.ask("calibrate-servo", calibration=values, save=save, lease=lease)

    async def begin_trial(self, calibration: ServoCalibration) -> str:
        """Take the fish and try a calibration; return the lease."""
        lease: str = (await self.ask("take-lease", name="calibrate")).lease
        await self.calibrate(calibration, lease=lease)
        return lease

    async def expect_refusal(self, op: str, **args: Any) -> str:
        """Return the code with which a request is refused."""
        with pytest.raises(Refused) as refusal:
            await self.ask(op, **args)
        return refusal.value.code

    async def until_over(self, limit: float = 20.0) -> None:
        """Tick until no calibration is on trial, for at most `limit` of virtual time [s].

        fishd checks leases in real time; after the last tick, this waits for it without ticks.
        """
        last = self.rig.now + limit
        async with asyncio.timeout(PATIENCE):
            while (await self.ask("calibrations")).on_trial:
                if self.rig.now < last:
                    self.rig.run_for(self.rig.config.tick)
                await asyncio.sleep(0.005)


async def wait_for_lease_checks() -> None:
    """Give fishd time to check its leases a few times, without ticks."""
    await asyncio.sleep(0.3)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[LockstepRig]:
    narrow = ("servo.lowest=-0.2", "servo.highest=0.2")
    with lockstep_rig(tmp_path, *narrow, "force_sensor.data_rate=128") as rig:
        rig.run_for(0.5)
        yield rig


Story = Callable[[Client], Awaitable[None]]


def run_story(rig: LockstepRig, story: Story) -> None:
    async def run() -> None:
        await story(Client(rig))

    asyncio.run(run())


@pytest.mark.parametrize("ended", ["end-lease", "set-controller"])
def test_a_calibration_whose_lease_ends_while_it_is_saved_is_not_used_at_the_next_start(
    rig: LockstepRig, monkeypatch: pytest.MonkeyPatch, ended: str
) -> None:
    saving, may_continue = threading.Event(), threading.Event()

    def save(*args: Any) -> Any:
        saving.set()
        assert may_continue.wait(PATIENCE)
        return original_save(*args)

    original_save = CalibrationFolder.save
    monkeypatch.setattr(CalibrationFolder, "save", save)

    async def story(client: Client) -> None:
        lease = None
        if ended == "end-lease":
            lease = await client.begin_trial(NARROW_LIMITS)
        task = asyncio.create_task(client.calibrate(NARROW_LIMITS, save=True, lease=lease))
        await asyncio.to_thread(saving.wait, PATIENCE)
        if lease:
            await client.ask("end-lease", lease=lease)
        else:
            rig.start("swing")
        may_continue.set()
        with pytest.raises(Refused, match=r"no longer holds the fish|is the active controller"):
            await task
        assert not list(state_folder(rig.config).glob("servo-*"))
        assert (await client.ask("calibrations")).servo_file is None

    run_story(rig, story)


def levels_of_undo_events(rig: LockstepRig) -> list[str]:
    return [event.level for event in rig.recorder.events if "previous calibration" in event.message]


def test_a_lease_without_renewal_ends_at_neutral_as_calibrated_before(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        before = (await client.ask("calibrations")).servo
        lease = await client.begin_trial(WIDE_LIMITS)
        await client.ask("set-controller", name="hold", parameters={"angle": 0.4}, lease=lease)
        rig.run_for(2.0)
        assert rig.pulse == pytest.approx(1530 + 240)
        await client.until_over()
        assert (await client.ask("calibrations")).servo == before
        rig.run_for(0.2)
        assert (rig.mode, rig.pulse) == ("idle", pytest.approx(1500.0))
        await client.ask("set-controller", name="hold", parameters={"angle": 0.4})
        assert rig.run_for(2.0)[-1].phi_c == 0.2

    run_story(rig, story)
    assert levels_of_undo_events(rig) == ["warning"]
    assert rig.mode == "running"


def test_a_lease_lasts_as_long_as_it_is_renewed_or_changed(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        lease = await client.begin_trial(WIDE_LIMITS)
        rig.run_for(0.5 * DEFAULT_LEASE_S)
        await client.ask("renew-lease", lease=lease)
        rig.run_for(0.5 * DEFAULT_LEASE_S)
        await client.calibrate(WIDE_LIMITS, lease=lease)
        rig.run_for(0.5 * DEFAULT_LEASE_S)
        await wait_for_lease_checks()
        assert (await client.ask("calibrations")).on_trial
        rig.run_for(DEFAULT_LEASE_S)
        await client.until_over(0.0)
        for op in ("renew-lease", "end-lease"):
            assert await client.expect_refusal(op, lease=lease) == "no-lease"
        with pytest.raises(Refused, match="it was not renewed for 2 s"):
            await client.calibrate(WIDE_LIMITS, lease=lease)

    run_story(rig, story)


def test_status_tells_that_the_servo_is_leased(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        assert not (await client.ask("status")).calibrating
        lease = await client.begin_trial(WIDE_LIMITS)
        assert (await client.ask("status")).calibrating
        await client.calibrate(WIDE_LIMITS, save=True, lease=lease)
        assert not (await client.ask("status")).calibrating

    run_story(rig, story)


def test_a_lease_that_is_given_back_ends_at_once_and_without_a_warning(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        before = (await client.ask("calibrations")).servo
        lease = await client.begin_trial(WIDE_LIMITS)
        await client.ask("set-controller", name="hold", parameters={"angle": 0.4}, lease=lease)
        rig.run_for(1.0)
        await client.ask("end-lease", lease=lease)
        assert await client.expect_refusal("renew-lease", lease=lease) == "no-lease"
        for name in ("swing", "hold"):  # the tail has to reach neutral first
            assert await client.expect_refusal("set-controller", name=name) == "calibrating"
        await client.until_over(1.0)
        assert (await client.ask("calibrations")).servo == before

    run_story(rig, story)
    assert levels_of_undo_events(rig) == ["info"]


def test_nothing_but_hold_takes_over_while_a_lease_lasts(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        lease = await client.begin_trial(WIDE_LIMITS)
        for arguments in ({"name": "swing", "lease": lease}, {"name": "swing"}, {"name": "hold"}):
            assert await client.expect_refusal("set-controller", **arguments) == "calibrating"
        assert (await client.ask("set-controller", name="hold", lease=lease)).mode == "running"
        await client.ask("end-lease", lease=lease)
        await client.until_over()
        assert (await client.ask("set-controller", name="swing")).controller == "swing"

    run_story(rig, story)


def test_a_controller_still_loading_when_a_lease_began_is_dropped(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        swimming = asyncio.create_task(client.ask("set-controller", name="swing"))
        await asyncio.sleep(0)  # starts loading it in a thread
        await client.begin_trial(WIDE_LIMITS)
        with pytest.raises(Refused) as refusal:
            await swimming
        assert refusal.value.code == "calibrating"

    run_story(rig, story)
    assert rig.mode == "idle"


@pytest.mark.parametrize("given_back", [False, True])
def test_a_controller_that_was_to_begin_after_a_rest_does_not_begin_in_a_lease_or_after_it(
    rig: LockstepRig, given_back: bool
) -> None:
    async def story(client: Client) -> None:
        square = registry.create("square", {}, rig.config.limits)
        rig.loop.set_controller_after(3.0, "square", square)
        rig.run_for(1.0)
        lease = await client.begin_trial(WIDE_LIMITS)
        rig.run_for(0.1)
        if given_back:
            await client.ask("end-lease", lease=lease)
            await client.until_over()
        assert {tick.mode for tick in rig.run_for(4.0)} == {"idle"}

    run_story(rig, story)
    warnings = [event for event in rig.recorder.events if event.level == "warning"]
    assert [event.message for event in warnings if event.kind == "calibration"] == [
        "square will not start by itself: the servo has another calibration now"
    ]


def test_only_who_has_the_lease_changes_or_saves_a_servo_calibration(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        lease = await client.begin_trial(WIDE_LIMITS)
        for save in (False, True):
            with pytest.raises(Refused) as refusal:
                await client.calibrate(ServoCalibration(), save=save)
            assert refusal.value.code == ("leased" if save else "no-lease")
            with pytest.raises(Refused) as refusal:
                await client.calibrate(ServoCalibration(), save=save, lease="another")
            assert refusal.value.code == "no-lease"
        saved = await client.calibrate(WIDE_LIMITS, save=True, lease=lease)
        assert (saved.on_trial, saved.servo.trim) == (False, 30.0)
        rig.run_for(DEFAULT_LEASE_S + 1.0)
        await wait_for_lease_checks()
        present = await client.ask("calibrations")
        assert (present.servo, present.servo_file) == (saved.servo, saved.servo_file)

    run_story(rig, story)
    assert levels_of_undo_events(rig) == []


def test_after_an_emergency_stop_a_lease_ends_before_the_tail_moves(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        lease = await client.begin_trial(WIDE_LIMITS)
        await client.ask("set-controller", name="hold", parameters={"angle": 0.4}, lease=lease)
        rig.run_for(1.0)
        await client.ask("estop")
        assert await client.expect_refusal("end-lease", lease=lease) == "no-lease"
        rig.run_for(0.5)
        await wait_for_lease_checks()
        # The previous limits would not permit the angle at which the pulses start again.
        assert (await client.ask("calibrations")).on_trial
        await client.ask("clear-fault")
        assert await client.expect_refusal("set-controller", name="swing") == "calibrating"
        await client.until_over()
        assert (await client.ask("calibrations")).servo.highest == 0.2

    run_story(rig, story)
    assert rig.mode == "idle"


def test_a_fault_meanwhile_does_not_keep_a_lease_from_ending(rig: LockstepRig) -> None:
    async def story(client: Client) -> None:
        lease = await client.begin_trial(WIDE_LIMITS)
        await client.ask("set-controller", name="hold", parameters={"angle": 0.4}, lease=lease)
        rig.run_for(1.0)
        rig.pi.faults.inject("unplugged")
        rig.run_until_fault(3.0)
        await client.until_over()
        assert (await client.ask("calibrations")).servo.highest == 0.2
        rig.run_for(1.0)  # gives the servo time to arrive before its pulses end

    run_story(rig, story)
    assert (rig.mode, rig.pulse) == ("fault", 0.0)
