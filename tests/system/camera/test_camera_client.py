"""What a client of a camera does while clocks cannot be asked."""

import os
import signal
import time
from pathlib import Path

import pytest
from rigs.camera_process import v4l2_rig
from rigs.processes import PATIENCE, running

from fishd.camera import clock_offset
from fishd.camera.clock_offset import QUICK
from fishd.client import Fish


def test_a_fishd_that_does_not_answer_keeps_nobody_waiting_for_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock_offset, "boot_id", lambda: "another machine than theirs")
    monkeypatch.setattr(clock_offset, "AGAIN", 0.2)
    with (
        running(tmp_path) as daemon,
        v4l2_rig(tmp_path, "v4l2.rate=60") as camera,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
        camera.client(fish=fish) as client,
    ):
        assert client.poll(PATIENCE)
        assert abs(client.offset().seconds) < 0.1
        os.kill(daemon.process.pid, signal.SIGSTOP)
        try:
            longest, frames = 0.0, []
            ends = time.monotonic() + 3.0
            while (begun := time.monotonic()) < ends or len(frames) <= 20:
                assert begun < ends + PATIENCE
                frames += client.poll(0.01)
                longest = max(longest, time.monotonic() - begun)
        finally:
            os.kill(daemon.process.pid, signal.SIGCONT)
    assert longest < 30.0  # not for as long as an answer may take otherwise
    assert longest > 0.5 * QUICK  # it was asked
    assert all(abs(frame.time - ends) < PATIENCE for frame in frames)
