"""Processes that do not answer: those that lack processor time, and those that hang."""

import pytest

from fishd.daemon.gateway.starvation import Thread, is_starved, parse_thread, read_threads

STAT = (
    b"29107 (a) T (b) R 29104 29104 23056 0 -1 4194304 2840 6506 6 2 103 2 4 2 20 0 1 0 1167590 "
    b"16973824 3350 18446744073709551615 94186520449024 94186520449365 140737463703344 0 0 0 0 "
    b"16781312 2 0 0 0 17 1 0 0 0 0 0 94186520460720 94186520461336 94186866884608 "
    b"140737463707900 140737463707947 140737463707947 140737463709647 0\n"
)


def test_a_thread_is_read_whatever_its_name_contains() -> None:
    assert parse_thread(STAT) == Thread("R", 1.05)


@pytest.mark.parametrize(
    ("states", "used", "starved"),
    [
        ("R", 0.0, True),
        ("R", 0.07, True),
        ("R", 0.08, False),  # it computes, but does not answer
        ("S", 0.0, False),  # it sleeps while a heartbeat waits
        ("SSR", 0.0, True),  # the main thread waits for another one
        ("RSS", 0.0, True),
        ("T", 0.0, False),  # SIGSTOP
        ("TRR", 0.0, False),
        ("t", 0.0, False),  # a debugger
        ("D", 0.0, False),
        ("DR", 0.0, False),
        ("Z", 0.0, False),
        ("", 0.0, False),  # it has ended
    ],
)
def test_only_a_process_that_could_run_and_did_not_is_starved(
    states: str, used: float, starved: bool
) -> None:
    before = [Thread("S", 5.0), Thread("S", 9.0), Thread("S", 7.0)]
    now = [Thread(state, 5.0 + used if not number else 10.0) for number, state in enumerate(states)]
    assert is_starved(before, now, 0.08) is starved


def test_a_process_that_has_ended_has_no_threads() -> None:
    assert read_threads(2**22 + 1) == []
