"""A simulated camera above a running fishd: real processes, in real time and in lockstep."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
from rigs.camera_process import CameraProcess, running_camera
from rigs.processes import PATIENCE, Daemon, Subscriber, running
from rigs.virtual_pi_process import virtual_pi

from fishd.camera.client import CameraLost
from fishd.camera.clock_offset import Offset
from fishd.camera.messages import FrameHeader
from fishd.camera.simulated import SimulatedCamera, SimulatedCameraSettings, Tail
from fishd.client import Agent, Fish
from fishd.core.camera_frames import TIME_TOLERANCE_S, Frame, Stack, StackSettings
from fishd.core.signals import Tick

TICK = 0.05
SWIMMING = ("--set", "start.controller=square", "--set", "start.parameters.frequency=1.5")


def settings(daemon: Daemon, *pairs: str) -> tuple[str, ...]:
    return (f"simulated.fishd={daemon.endpoint}", *pairs)


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with running(tmp_path_factory.mktemp("fishd"), *SWIMMING) as daemon:
        yield daemon


def expected(ticks: list[Tick], camera: SimulatedCameraSettings) -> dict[float, np.ndarray]:
    """Return the frames, by time, of the true states of successive ticks."""
    clean = SimulatedCamera(camera, 84)
    frames = {}
    tails = [Tail(t.time, float(t.alpha), float(t.alpha_rate)) for t in ticks]  # type: ignore[arg-type]
    for before, after in pairwise(tails):
        if after.time - before.time > 1.5 * TICK:  # fishd has skipped some in between
            continue
        for frame in clean.frames(before, after):
            frames[round(frame.time, 6)] = frame.pixels
    return frames


def test_from_another_machine_the_offset_is_estimated(
    tmp_path: Path, daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fishd.camera.clock_offset.read_boot_id", lambda: "of another machine")
    with (
        running_camera(tmp_path, *settings(daemon)) as camera,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
    ):
        camera.is_in("streaming")
        with camera.client(fish=fish) as client:
            estimate, offsets = client.offset, list[Offset]()

            def estimate_and_store() -> Offset:
                offsets.append(estimate())
                return offsets[-1]

            monkeypatch.setattr(client, "offset", estimate_and_store)
            received: list[tuple[FrameHeader, Frame]] = []
            while len(received) < 5:
                received += client.poll_with_headers(PATIENCE)
    offset = offsets[-1]  # that of the last frame; later ones may differ
    assert 0.0 < offset.uncertainty < 1.0
    assert abs(offset.seconds) <= offset.uncertainty  # in truth both use one clock
    sent, frame = received[-1]
    assert frame.time == pytest.approx(sent.time, abs=offset.uncertainty)


def test_the_camera_waits_for_a_fishd_and_follows_it_through_a_restart(tmp_path: Path) -> None:
    endpoint = f"ipc://{tmp_path}/control"
    with running_camera(tmp_path, f"simulated.fishd={endpoint}") as camera:
        state = camera.is_in("waiting")
        assert state.problem.startswith(f"no fishd at {endpoint}")
        sessions = {state.session}
        for _ in range(2):
            with running(tmp_path, *SWIMMING) as daemon:
                sessions.add(camera.is_in("streaming").session)
                daemon.kill()
            camera.is_in("waiting")
    assert len(sessions) == 3


def test_a_fishd_that_drives_no_simulated_fish_is_named(tmp_path: Path) -> None:
    with (
        virtual_pi(tmp_path) as pi,
        running(tmp_path, *pi.settings) as daemon,
        running_camera(tmp_path, *settings(daemon)) as camera,
    ):
        state = camera.is_in("unusable")
    assert state.problem == "a virtual Pi does not publish the position of the tail"
    assert state.remedy == "start fishd with robot: simulated"


class Lockstep:
    """An agent that waits for its camera in each tick."""

    def __init__(self, daemon: Daemon, camera: CameraProcess, stack: StackSettings) -> None:
        self.fish = Fish(daemon.endpoint, timeout=PATIENCE)
        self.agent = Agent(f"{daemon.endpoint}-agent", timeout=PATIENCE)
        self.fish.set_controller("remote", agent=self.agent.address)
        # From here on no tick ends before the agent has acted.
        self.client = camera.client(fish=self.fish, stack=stack, timeout=4.0)

    def __enter__(self) -> "Lockstep":
        return self

    def __exit__(self, *_: object) -> None:
        for connection in (self.client, self.agent, self.fish):
            connection.close()

    def swim(self, ticks: int) -> list[Stack | None]:
        seen: list[Stack | None] = []
        for number in range(ticks):
            asked = self.agent.observe()
            seen.append(self.client.stack_at(asked.time))
            self.agent.act(0.3 if number % 8 < 4 else -0.3)
        return seen


@pytest.mark.parametrize("rate", ["null", "400"])
def test_in_lockstep_every_tick_has_its_frames_at_any_speed(tmp_path: Path, rate: str) -> None:
    with (
        running(tmp_path, "--set", "lockstep=true") as daemon,
        running_camera(tmp_path, *settings(daemon, f"simulated.rate={rate}")) as camera,
    ):
        camera.is_in("streaming")
        with Lockstep(daemon, camera, StackSettings(frames=2)) as run:
            seen = run.swim(120)
            assert run.client.missed == 0
            assert run.client.status().virtual
    stacks = [stack for stack in seen[10:] if stack is not None]
    assert len(stacks) == len(seen) - 10
    different = [np.any(a[0] != b[0]) for a, b in pairwise(stacks)]
    assert sum(different) > 106


def test_in_lockstep_a_frame_is_the_same_as_beside_the_simulation(tmp_path: Path) -> None:
    small = ("simulated.width=84", "simulated.height=84")
    clean = ("simulated.noise=0", "simulated.rate=null", *small)
    with (
        running(tmp_path, "--set", "lockstep=true") as daemon,
        running_camera(tmp_path, *settings(daemon, *clean)) as camera,
    ):
        camera.is_in("streaming")
        with Subscriber(daemon.telemetry, b"tick") as telemetry:
            telemetry.message()  # from here on none is missed
            with Lockstep(daemon, camera, StackSettings(frames=2)) as run:
                run.swim(40)
                ticks = [msgspec.convert(telemetry.message(), Tick)]
                while ticks[-1].time < run.agent.latest.time - TIME_TOLERANCE_S:
                    ticks.append(msgspec.convert(telemetry.message(), Tick))
                frames = {round(f.time, 6): f.pixels for f in run.client.history._frames}
    truth = expected(ticks, SimulatedCameraSettings(noise=0.0))
    shared = frames.keys() & truth.keys()
    assert len(shared) > 30
    assert all(np.array_equal(frames[key], truth[key]) for key in shared)


def test_in_lockstep_a_camera_that_dies_is_noticed(tmp_path: Path) -> None:
    with (
        running(tmp_path, "--set", "lockstep=true") as daemon,
        running_camera(tmp_path, *settings(daemon)) as camera,
    ):
        camera.is_in("streaming")
        with Lockstep(daemon, camera, StackSettings(frames=2)) as run:
            run.swim(20)
            camera.process.kill()
            with pytest.raises(CameraLost, match="no camera at"):
                run.swim(20)
