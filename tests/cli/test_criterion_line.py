"""`fishctl status` says which C `swing --C auto` uses."""

from rigs.processes import Daemon


def test_status_says_which_criterion_a_search_uses(daemon: Daemon) -> None:
    daemon.fishctl("set-controller", "swing", "--C", "auto")
    (line,) = (
        line for line in daemon.fishctl("status").stdout.splitlines() if line.startswith("C auto")
    )
    assert line.split(maxsplit=2)[2] == "C = 0.6 on trial, or the best so far"
    daemon.fishctl("set-controller", "swing")
    assert "C auto" not in daemon.fishctl("status").stdout
