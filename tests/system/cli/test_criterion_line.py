"""`fishctl status` says which C `swing --C auto` uses."""

from rigs.processes import Daemon, wait_until


def test_status_says_which_criterion_a_search_uses(daemon: Daemon) -> None:
    line = "C = 0.6 on trial, or the best yet"
    daemon.fishctl("set-controller", "swing", "--C", "auto")
    wait_until(lambda: line in daemon.fishctl("status").stdout)  # from the first tick on
    daemon.fishctl("set-controller", "swing")
    assert "C auto" not in daemon.fishctl("status").stdout
