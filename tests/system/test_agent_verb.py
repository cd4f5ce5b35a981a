"""`fishctl agent`: a policy controls a real fishd and sees through a real fishd-camera."""

import re
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rigs.camera_process import CameraProcess, running_camera
from rigs.policy_files import FLIP, seeing_card, velocity_follower, write
from rigs.processes import FISHCTL, PATIENCE, Daemon, Process, Subscriber, running, sets, wait_until

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.client import Fish
from fishd.config import Config
from fishd.core.camera_frames import StackSettings
from fishd.core.protocol import State
from fishd.lab.compare import compare

CAMERA = (
    "picture.size=32",
    "simulated.latency=0.01",
    "simulated.width=32",
    "simulated.height=32",
)
"""Settings of a camera whose pictures are those of a comparison."""
LINE = re.compile(r" +([\d.]+) s +([\d.]+) Hz  thrust +(-?[\d.]+) mN  \|φ_c\| +(\d+)% of Φ")


@pytest.fixture(scope="module")
def camera(
    tmp_path_factory: pytest.TempPathFactory, shared_daemon: Daemon
) -> Iterator[CameraProcess]:
    folder = tmp_path_factory.mktemp("camera")
    with running_camera(folder, *CAMERA, f"simulated.fishd={shared_daemon.endpoint}") as camera:
        camera.is_in("streaming")
        yield camera


@pytest.fixture
def eye(tmp_path: Path) -> str:
    return str(write(tmp_path, velocity_follower(), "eye"))


class AgentProcess(Process):
    """A running `fishctl agent` that sees through a camera."""

    def __init__(self, daemon: Daemon, camera: CameraProcess, *words: str) -> None:
        own = ("--endpoint", daemon.endpoint, "--camera", camera.endpoint)
        super().__init__(FISHCTL, "agent", *own, *words)

    def wait_for_line(self, wanted: str) -> None:
        """Wait for this line on standard error, after any other lines."""
        assert self.process.stderr
        for line in self.process.stderr:
            if line == f"{wanted}\n":
                return
        raise AssertionError(f"it has ended without '{wanted}'")


def read_rows(done: tuple[int, str, str]) -> list[tuple[float, ...]]:
    """Return time [s], frequency [Hz], thrust [mN] and |φ_c| [% of Φ] of each line."""
    return [tuple(map(float, match.groups())) for match in LINE.finditer(done[1])]


def check_refused(done: subprocess.CompletedProcess[str]) -> str:
    """Check that a command was check_refused in one line; return it."""
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


@pytest.mark.realtime
def test_a_policy_swims_in_real_time_by_what_the_camera_shows(
    daemon: Daemon, camera: CameraProcess, eye: str
) -> None:
    with AgentProcess(daemon, camera, eye, "--seconds", "8") as agent:
        done = agent.finish()
    assert (done[0], done[2]) == (0, ""), done
    assert done[1].startswith(f"{eye} swims; it sees pictures; Ctrl-C ends it\n")
    assert done[1].endswith("the fish rests, after 8 s\n")
    lines = read_rows(done)
    assert 6 <= len(lines) <= 8
    assert lines[-1][1] > 0.6
    assert lines[-1][2] > 8.0
    assert daemon.status().mode == "idle"


def test_in_lockstep_it_swims_as_in_a_comparison(tmp_path: Path, eye: str) -> None:
    with (
        running(tmp_path, *sets("lockstep=true")) as daemon,
        running_camera(tmp_path, *CAMERA, f"simulated.fishd={daemon.endpoint}") as camera,
    ):
        camera.is_in("streaming")
        with (
            Subscriber(daemon.telemetry, b"tick").connected() as ticks,
            AgentProcess(daemon, camera, eye, "--seconds", "30") as agent,
        ):
            tick, forces = ticks.until(controller="remote", mode="running"), []
            while (tick["controller"], tick["mode"]) == ("remote", "running"):
                forces.append(tick["fx"])
                tick = ticks.message()
            done = agent.finish(patience=3 * PATIENCE)
    assert (done[0], done[2]) == (0, ""), done
    assert len(forces) >= 600
    rig = SimulatedCameraSettings(latency=0.01)
    standings, _ = compare(Config(), [eye], seconds=30.0, settle=10.0, camera=rig)
    settled = forces[200:600]
    assert sum(settled) / len(settled) == pytest.approx(standings[0].thrust, rel=0.1)


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_the_fish_at_neutral(
    daemon: Daemon, camera: CameraProcess, eye: str, number: int
) -> None:
    with AgentProcess(daemon, camera, eye) as agent:
        wait_until(lambda: daemon.status().controller == "remote")
        status, out, err = agent.end(number)
    assert (status, err) == (0, "")
    assert re.search(r"the fish rests, after \d+ s\n$", out)
    assert daemon.status().mode == "idle"


@pytest.mark.realtime
def test_a_camera_that_dies_ends_it_at_neutral(tmp_path: Path, daemon: Daemon, eye: str) -> None:
    with running_camera(tmp_path, *CAMERA, f"simulated.fishd={daemon.endpoint}") as camera:
        camera.is_in("streaming")
        with (
            AgentProcess(daemon, camera, eye) as agent,
            Subscriber(daemon.telemetry, b"tick") as ticks,
        ):
            ticks.until(controller="remote", mode="running", phi_c=0.42)
            camera.end(signal.SIGKILL)
            status, _, err = agent.finish()
    assert status == 1
    waits, lost = err.splitlines()[-2:]
    assert waits == "no frames: the fish waits at neutral"
    assert lost.startswith(f"fishctl: no camera at {camera.endpoint}: no answer within 2 s")
    state = daemon.status()
    assert (state.mode, state.reason) == ("idle", None)


@pytest.mark.realtime
def test_a_camera_that_pauses_is_waited_for(tmp_path: Path, daemon: Daemon, eye: str) -> None:
    with running_camera(tmp_path, *CAMERA, f"simulated.fishd={daemon.endpoint}") as camera:
        camera.is_in("streaming")
        with (
            AgentProcess(daemon, camera, eye) as agent,
            Subscriber(daemon.telemetry, b"tick") as ticks,
        ):
            ticks.until(controller="remote", mode="running", phi_c=0.42)
            camera.stop()
            agent.wait_for_line("no frames: the fish waits at neutral")
            ticks.until(controller="remote", mode="running", phi_c=0.0)
            camera.process.send_signal(signal.SIGCONT)
            agent.wait_for_line("frames are back: it swims on")
            ticks.until(controller="remote", mode="running", phi_c=0.42)
            status, _, err = agent.end(signal.SIGINT)
    assert status == 0
    assert "fishctl:" not in err
    assert daemon.status().mode == "idle"


@pytest.mark.realtime
def test_a_policy_of_forces_swims_too_and_needs_no_camera(daemon: Daemon) -> None:
    done = daemon.fishctl("agent", "default-fish", "--seconds", "0.5")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("default-fish swims; it sees forces; Ctrl-C ends it\n")
    done = daemon.fishctl("agent", "default-fish", "--camera", "tcp://127.0.0.1:1")
    assert done.returncode == 2
    assert "--camera cannot be given here: this policy sees no pictures" in done.stderr


@pytest.mark.realtime
def test_a_policy_that_insists_on_chatter_gives_way_to_swing(
    tmp_path: Path, daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, FLIP)
    select = Fish.set_controller

    def slow(fish: Fish, name: str, /, **parameters: Any) -> State:
        seq = fish.status().seq
        while name == "swing" and fish.status().seq < seq + 8:  # more than may be missed
            time.sleep(0.02)
        return select(fish, name, **parameters)

    monkeypatch.setattr(Fish, "set_controller", slow)
    done = daemon.fishctl("agent", str(path), "--seconds", "10")
    assert done.returncode == 1
    assert "wanted to reverse sooner than 0.2 s after its last reversal; swing s" in done.stderr
    state = daemon.status()
    assert (state.mode, state.controller) == ("running", "swing")


def test_frames_of_another_size_or_rate_are_refused_before_anything_moves(
    tmp_path: Path, daemon: Daemon, camera: CameraProcess
) -> None:
    def refusal(pictures: StackSettings, tick: float = 0.05) -> str:
        content = velocity_follower(about=seeing_card(pictures=pictures, tick=tick))
        path = str(write(tmp_path, content, "other"))
        done = daemon.fishctl("agent", path, "--camera", camera.endpoint)
        assert daemon.status().mode == "idle"
        return check_refused(done)

    assert refusal(StackSettings(size=48, frames=2)) == (
        f"fishctl: {tmp_path}/other.onnx: frames of 48 x 48 pixels are needed (camera.stack.size), "
        f"the camera at {camera.endpoint} shows 32 x 32; start it with --set picture.size=48\n"
    )
    quick = StackSettings(size=32, frames=2, interval=0.02)
    assert re.search(
        r": 50 frames a second are needed, as those that are shown are 20 ms apart "
        r"\(camera.stack.interval\); the camera at \S+ gives [\d.]+ a second: a faster "
        r"camera is needed, or a training with camera.stack.interval: [\d.]+$",
        refusal(quick),
    )
    young = StackSettings(size=32, frames=2, interval=0.5, oldest=0.02)
    assert re.search(
        r": frames no older than 20 ms are needed \(camera.stack.delay \+ oldest\); those of the "
        r"camera at \S+ are there \d+ ms after their exposure, \d+ ms apart: a camera with less "
        r"latency is needed, or a training with camera.stack.delay: [\d.]+$",
        refusal(young),
    )
    refused = refusal(StackSettings(size=32, frames=2), tick=0.02)
    assert "trained at a tick of 20 ms, this robot's is 50 ms" in refused


def test_without_a_camera_it_says_how_to_start_one(daemon: Daemon, eye: str) -> None:
    unused = "tcp://127.0.0.1:9"
    line = check_refused(daemon.fishctl("agent", eye, "--camera", unused))
    assert line.startswith(f"fishctl: no camera at {unused}: ")
    assert "start one with 'fishd-camera'" in line
    assert daemon.status().mode == "idle"


@pytest.mark.realtime
def test_a_live_comparison_swims_by_sight(daemon: Daemon, camera: CameraProcess, eye: str) -> None:
    words = ("compare", "--on", "live", "--for", "21", eye, "--camera", camera.endpoint)
    done = daemon.fishctl_apart(*words, timeout=60.0)
    assert (done.returncode, done.stderr) == (0, "")
    row = done.stdout.splitlines()[2]
    assert row.startswith(eye)
    assert float(row.split()[1]) > 5.0
    state = daemon.status()
    assert (state.mode, state.reason) == ("idle", None)


@pytest.mark.realtime
def test_a_live_comparison_leaves_out_what_the_camera_does_not_suit(
    tmp_path: Path, daemon: Daemon, camera: CameraProcess
) -> None:
    content = velocity_follower(about=seeing_card(pictures=StackSettings(size=48, frames=2)))
    path = str(write(tmp_path, content, "large"))
    done = daemon.fishctl("compare", "--on", "live", path, "--camera", camera.endpoint)
    assert (done.returncode, done.stdout.count("\n")) == (1, 1)
    assert f"{path}: left out: frames of 48 x 48 pixels are needed" in done.stderr
    assert daemon.status().mode == "idle"


@pytest.mark.realtime
def test_a_dead_camera_ends_a_live_comparison(tmp_path: Path, daemon: Daemon, eye: str) -> None:
    with running_camera(tmp_path, *CAMERA, f"simulated.fishd={daemon.endpoint}") as camera:
        camera.is_in("streaming")
        own = ("--endpoint", daemon.endpoint, "compare", "--on", "live", eye)
        with (
            Process(FISHCTL, *own, "--camera", camera.endpoint) as comparing,
            Subscriber(daemon.telemetry, b"tick") as ticks,
        ):
            ticks.until(controller="remote", mode="running", phi_c=0.42)
            camera.end(signal.SIGKILL)
            status, out, err = comparing.finish()
    assert (status, out.count("\n")) == (1, 1)
    assert err.startswith(f"fishctl: {eye}: no camera at {camera.endpoint}: no answer within 2 s")
    state = daemon.status()
    assert (state.mode, state.reason) == ("idle", None)
