"""Permitted costs of a tick and a start-up, committed so that speed is not lost in small steps.

A change that needs more updates them with `python tools/budget.py --write`, and gives the reason.
"""

import pytest

import budget

COMMITTED = budget.committed()
RENEW = "make it cheaper, or run 'python tools/budget.py --write' and say why in the commit"


@pytest.mark.parametrize("robot", budget.TICKS)
@pytest.mark.parametrize("controller", budget.CONTROLLERS)
def test_a_tick_makes_no_more_calls_than_are_committed(robot: str, controller: str) -> None:
    if controller == "ppo":
        pytest.importorskip("onnxruntime", reason="install the extra 'policy'")
    calls = budget.calls_per_tick(robot, controller)
    permitted = COMMITTED["calls_per_tick"][robot][controller] * (1.0 + budget.ROOM)
    assert 0.0 < calls <= permitted, RENEW


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMITTED["start_up"])
def test_a_start_up_loads_no_more_than_is_committed(command: str) -> None:
    loaded, permitted = budget.start_up(command), COMMITTED["start_up"][command]
    assert set(loaded["packages"]) <= set(permitted["packages"]), RENEW
    for what in ("modules", "bytes"):
        assert 0 < loaded[what] <= permitted[what] * (1.0 + budget.ROOM), RENEW
