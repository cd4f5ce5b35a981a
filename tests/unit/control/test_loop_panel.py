"""The loop with an operator's panel, a servo that was lost, and a watchdog to feed."""

import dataclasses
from collections.abc import Callable

from rigs.harness import Rig

from fishd.core.clock import Slot
from fishd.hardware.base import Robot


class Button:
    """A panel whose button is pressed by a test."""

    on_press: Callable[[], None]

    def __init__(self) -> None:
        self.pressed = False
        self.error: OSError | None = None
        self.shown: list[str] = []

    def update(self, mode: str, now: float) -> bool:
        if self.error:
            raise self.error
        self.shown.append(mode)
        return self.pressed

    def close(self) -> None:
        self.shown.append("off")


def rig_with_button() -> tuple[Rig, Button]:
    button = Button()

    def wrap(robot: Robot) -> Robot:
        return dataclasses.replace(robot, panel=button)

    return Rig(wrap=wrap), button


def test_a_stop_cannot_be_cleared_while_the_button_is_pressed() -> None:
    rig, button = rig_with_button()
    button.pressed = True
    rig.run(1)
    rig.loop.clear_fault()
    assert not rig.run(1)[-1].servo_on
    assert rig.mode == "estop"
    button.pressed = False
    rig.loop.clear_fault()
    assert rig.run(1)[-1].servo_on


def test_a_pressed_button_stops_the_pulses_in_the_same_tick_and_is_one_event() -> None:
    rig, button = rig_with_button()
    rig.start("square")
    rig.run(10)
    button.pressed = True
    tick = rig.run(1)[-1]
    assert (rig.mode, tick.servo_on) == ("estop", False)
    rig.run(50)
    stops = [event.message for event in rig.recorder.events if "estop" in event.message]
    assert stops == ["running → estop: the E-stop button is pressed"]


def test_a_button_that_cannot_be_read_is_a_fault() -> None:
    rig, button = rig_with_button()
    rig.start("square")
    rig.run(5)
    button.error = OSError("no such pin")
    rig.run(20)
    assert (rig.mode, rig.reason) == ("fault", "estop-button")
    assert not rig.recorder.ticks[-1].servo_on


def test_the_panel_shows_the_mode_of_every_tick() -> None:
    rig, button = rig_with_button()
    rig.run(2)
    rig.start("square")
    rig.run(2)
    assert button.shown == ["idle", "idle", "running", "running"]


def test_every_tick_feeds_the_watchdog_whatever_the_mode_is() -> None:
    fed: list[float] = []
    rig = Rig(notify=fed.append)
    rig.run(3)
    rig.loop.estop("test")
    rig.run(3)
    assert len(fed) == 6
    rig.loop.tick(Slot(6, 0.3, 0.3, 0))
    assert len(fed) == 7
