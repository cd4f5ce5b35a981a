"""A fishd that ends while its pigpiod is stopped reports that the servo may keep its pulses."""

import signal
from pathlib import Path

from rigs.processes import Subscriber, fishctl, running
from rigs.virtual_pi_process import virtual_pi


def test_the_last_line_says_so_and_fishctl_estop_ends_the_pulses_later(tmp_path: Path) -> None:
    with virtual_pi(tmp_path) as pi:
        # This loads the drivers: the next start must be faster than pigpiod's countdown.
        assert fishctl("release", *pi.settings).stdout == "there were no pulses\n"
        with running(tmp_path, *pi.settings) as daemon:
            with Subscriber(daemon.telemetry, b"tick") as ticks:
                ticks.until(mode="running", servo_on=True)
                pi.control("inject", "pigpiod-frozen")
                ticks.until(mode="fault")
            code, _, errors = daemon.end(signal.SIGTERM)
        assert code == 1
        last = errors.splitlines()[-1]
        assert "the servo could not be released and may keep its pulses: pigpiod at 127." in last
        command = ["estop", "--endpoint", daemon.endpoint]
        assert last.endswith(f"; once it can be reached, 'fishctl {' '.join(command)}' ends them")
        assert "reconnecting" not in last
        assert pi.pulse() > 0.0
        pi.control("clear")
        ended = fishctl(*command)
        assert "pulses were on: neutral, then off" in ended.stdout, ended.stderr
        pi.wait_until_released()
