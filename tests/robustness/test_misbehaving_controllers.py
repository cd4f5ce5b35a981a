"""For any exception in any method of a controller, the loop continues and reports the reason."""

from typing import Any

import msgspec
import pytest
from fishd_zoo import BAD, RAISED, Zoo, ZooParameters
from rigs.harness import LIMITS, Rig

from fishd.core import text

pytestmark = pytest.mark.usefixtures("sigint_ignored")


def started(method: str, deed: str) -> Rig:
    return Rig().start(Zoo(ZooParameters(method=method, deed=deed), LIMITS))


def check_latched(rig: Rig) -> None:
    """Check for a fault with a reason that can be sent, and for continuing ticks."""
    reason = rig.loop.supervisor.reason
    assert reason is not None
    assert reason.code == "controller-error"
    assert reason.message.startswith("controller zoo ")
    assert reason.message.isprintable()
    assert len(reason.message) <= text.MAX_LINE_CHARACTERS
    msgspec.json.encode(reason)
    assert rig.recorder.kinds().count("fault") == 1
    for event in rig.recorder.events:
        assert event.message.isprintable()
        msgspec.json.encode(event)
    assert rig.run(40)[-1].servo_on is False
    rig.loop.clear_fault()
    rig.start("square")
    assert rig.run(20)[-1].mode == "running"


@pytest.mark.parametrize("deed", RAISED)
@pytest.mark.parametrize("method", ["activate", "update"])
def test_an_exception_in_the_tick_is_a_fault(method: str, deed: str) -> None:
    rig = started(method, deed)
    rig.run(1)
    assert rig.mode == "fault"
    check_latched(rig)


@pytest.mark.parametrize("deed", RAISED)
def test_an_exception_in_close_changes_nothing(deed: str) -> None:
    rig = started("close", deed)
    rig.run(3)
    rig.loop.stop()
    rig.run(3)
    assert (rig.mode, rig.reason) == ("idle", None)
    rig.start("square")
    assert rig.run(3)[-1].mode == "running"


@pytest.mark.parametrize("deed", RAISED)
def test_an_exception_in_retune_is_for_whoever_asked(deed: str) -> None:
    rig = started("retune", deed)
    rig.run(3)
    with pytest.raises(Exception) as caught:  # noqa: PT011  (that it is one is what matters)
        rig.loop.active.retune(ZooParameters(method="retune", deed=deed, nudge=1))
    assert text.describe_error(caught.value)
    assert rig.loop.active.parameters["nudge"] == 0
    assert rig.run(3)[-1].mode == "running"


@pytest.mark.parametrize("deed", BAD)
def test_what_is_no_angle_is_a_fault_that_says_so(deed: str) -> None:
    rig = started("update", deed)
    rig.run(1)
    check_latched(rig)


class Forgetful(Zoo):
    """Controller that loses its parameters."""

    def __init__(self, lost: Any) -> None:
        super().__init__(ZooParameters(), LIMITS)
        self.parameters = lost


@pytest.mark.parametrize("lost", [None, {"a": 1}, 3, ZooParameters(deed="\udcff")])
def test_a_controller_that_lost_its_parameters_does_not_take_over(lost: Any) -> None:
    rig = Rig().start("square")
    rig.run(3)
    with pytest.raises(Exception) as caught:  # noqa: PT011  (that it is one is what matters)
        rig.start(Forgetful(lost))
    assert text.describe_error(caught.value)
    assert rig.loop.active.name == "square"
    assert rig.run(3)[-1].mode == "running"
