"""Another server on pigpiod's port, and a pigpiod that is too old, as users meet them."""

import re

from rigs.operator_rig import Bench
from rigs.other_servers import other_server
from rigs.processes import fishctl, running, sets, wait_until


def test_fishd_doctor_and_release_say_that_it_is_not_pigpiod(pi: Bench) -> None:
    with other_server("ssh") as port:
        problem = f"pigpiod at 127.0.0.1:{port}: it is not pigpiod: it answers command "
        settings = (*pi.settings, *sets(f"servo.port={port}"))
        ended = fishctl("release", *settings)
        assert (ended.returncode, ended.stdout) == (1, "")
        assert re.fullmatch(f"fishctl: {problem}[^\n]+\n", ended.stderr)
        shown = fishctl("doctor", *settings, "--endpoint", "ipc:///nowhere").stdout
        assert f"FAIL     pigpiod        {problem}" in shown
        assert "start pigpiod at another port (-p) and set servo.port" in shown
        assert "'sudo ss -tlnp' names it" in shown
        with running(pi.folder, *settings) as fishd:
            why = problem.partition(": ")[2]
            wait_until(lambda: why in fishd.fishctl("status").stdout)


def test_a_pigpiod_that_is_too_old_is_named_by_fishd_and_doctor(pi: Bench) -> None:
    pi.pi.inject("pigpiod-old")
    line = f"pigpiod at 127.0.0.1:{pi.pi.port()} is version 60, too old: it does not know PROCU"
    shown = fishctl("doctor", *pi.settings, "--endpoint", "ipc:///nowhere").stdout
    assert f"FAIL     pigpiod        {line}" in shown
    assert "install pigpio 79" in shown
    with pi.daemon() as fishd:
        wait_until(lambda: line in fishd.fishctl("status").stdout)
