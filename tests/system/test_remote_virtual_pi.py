"""A remote agent on the robot's own drivers, in real time."""

import time
from pathlib import Path

import pytest
from rigs.processes import running
from rigs.virtual_pi_process import virtual_pi

from fishd.learning.links.fishd_link import FishdLink


@pytest.mark.realtime
def test_an_agent_swims_the_virtual_pi(tmp_path: Path) -> None:
    with virtual_pi(tmp_path) as pi, running(tmp_path, *pi.settings) as daemon:
        link = FishdLink(daemon.endpoint, deadline=0.0225)
        try:
            link.reset()
            in_time = 0
            for step in range(40):
                angle = 0.3 if step % 12 < 6 else -0.3
                observation, lost = link.step(angle)
                if not lost:
                    in_time += 1
                    assert abs(observation.instruction_angle - angle) < 1e-6
            assert in_time > 20
            link.pause(10.0)
            time.sleep(0.5)
            rested = link.resume()
            assert rested.time > observation.time + 0.4
            assert rested.instruction_angle == 0.0
        finally:
            link.close()
