"""The E-stop button and the status light: the real rpi-lgpio on emulated pins."""

import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from fishd.core.clock import VirtualClock
from fishd.hardware.panel import RpiGpioPanel
from fishd.hardware.settings import PanelSettings
from fishd.virtual.pi.lgpio import PULL_NONE, PULL_UP, EmulatedLgpio, Pins

BUTTON, LIGHT = 17, 27
OPENS = PanelSettings(estop_gpio=BUTTON, estop_pressed="high", led_gpio=LIGHT)
CLOSES = PanelSettings(estop_gpio=BUTTON, estop_pressed="low")
GROUND = 0
OPEN = None  # a contact that is open, or a broken wire

Make = Callable[[PanelSettings], RpiGpioPanel]


@pytest.fixture
def pins() -> Iterator[Pins]:
    pins = Pins()
    with EmulatedLgpio(pins):
        yield pins


@pytest.fixture
def make(pins: Pins) -> Iterator[Make]:
    """Return a function that makes panels, which are closed after the test."""
    panels = []

    def make_panel(settings: PanelSettings) -> RpiGpioPanel:
        panels.append(RpiGpioPanel(settings, VirtualClock()))
        return panels[-1]

    yield make_panel
    for panel in panels:
        panel.close()


@pytest.fixture
def panel(pins: Pins, make: Make) -> RpiGpioPanel:
    """Panel whose button is released: its contact is closed."""
    pins.set_level(BUTTON, GROUND)
    return make(OPENS)


def test_a_press_is_reported_at_once_by_a_library_thread(pins: Pins, panel: RpiGpioPanel) -> None:
    threads = []
    panel.on_press = lambda: threads.append(threading.current_thread())
    pins.set_level(BUTTON, OPEN)
    assert len(threads) == 1
    assert threads[0] is not threading.current_thread()


def test_a_press_is_reported_once_however_it_bounces(pins: Pins, panel: RpiGpioPanel) -> None:
    presses = []
    panel.on_press = lambda: presses.append(1)
    for level in (OPEN, GROUND, OPEN, GROUND, OPEN):
        pins.set_level(BUTTON, level)
    assert presses == [1]
    for time in range(3):
        assert panel.update("estop", 0.05 * time) is True


def test_a_press_between_two_ticks_is_seen(pins: Pins, panel: RpiGpioPanel) -> None:
    panel.update("running", 0.0)
    pins.set_level(BUTTON, OPEN)
    pins.set_level(BUTTON, GROUND)
    assert panel.update("running", 0.05) is True
    assert panel.update("running", 0.10) is False


def test_a_release_takes_two_polls(pins: Pins, panel: RpiGpioPanel) -> None:
    pins.set_level(BUTTON, OPEN)
    assert panel.update("estop", 0.0) is True
    pins.set_level(BUTTON, GROUND)
    assert panel.update("estop", 0.05) is True
    pins.set_level(BUTTON, OPEN)
    assert panel.update("estop", 0.10) is True
    pins.set_level(BUTTON, GROUND)
    assert panel.update("estop", 0.15) is True
    assert panel.update("estop", 0.20) is False


def test_a_spike_that_is_gone_when_looked_at_is_no_press(pins: Pins, panel: RpiGpioPanel) -> None:
    presses = []
    panel.on_press = lambda: presses.append(1)
    (callback,) = pins.callbacks
    callback.function(0, BUTTON, 1, 0)  # an edge, and the level is low again
    assert presses == []
    assert panel.update("running", 0.0) is False


def test_a_broken_wire_is_a_press_where_the_button_opens_a_contact(pins: Pins, make: Make) -> None:
    pins.set_level(BUTTON, OPEN)
    panel = make(OPENS)
    assert pins.lines[BUTTON].pull == PULL_UP
    assert panel.update("idle", 0.0) is True


def test_a_button_that_closes_a_contact_is_pressed_when_low(pins: Pins, make: Make) -> None:
    panel = make(CLOSES)
    assert pins.lines[BUTTON].pull == PULL_UP
    assert panel.update("running", 0.0) is False
    pins.set_level(BUTTON, GROUND)
    assert panel.update("running", 0.05) is True


def test_without_edges_polls_do(pins: Pins, make: Make, caplog: pytest.LogCaptureFixture) -> None:
    pins.reports_edges = False
    pins.set_level(BUTTON, GROUND)
    panel = make(OPENS)
    (message,) = caplog.messages
    assert message.startswith("E-stop button on GPIO 17 is polled only, once a tick: bad event")
    for tick in range(20):
        assert panel.update("running", 0.05 * tick) is False
    pins.set_level(BUTTON, OPEN)
    assert panel.update("running", 1.0) is True
    assert len(caplog.messages) == 1


def record_light(
    pins: Pins, panel: RpiGpioPanel, mode: str, tick: float, seconds: float
) -> list[int]:
    """Return the level of the light after each tick."""
    levels = []
    for index in range(round(seconds / tick)):
        panel.update(mode, 100.0 + index * tick)
        levels.append(pins.lines[LIGHT].level())
    return levels


def count_flashes(levels: list[int]) -> int:
    """Return how often the light went on."""
    return sum(after > before for before, after in zip([0, *levels], levels, strict=False))


@pytest.mark.parametrize("tick", [0.01, 0.2])
def test_the_light_flashes_each_second_idle(pins: Pins, panel: RpiGpioPanel, tick: float) -> None:
    levels = record_light(pins, panel, "idle", tick, 10.0)
    assert count_flashes(levels) == 10
    assert sum(levels) == pytest.approx(0.2 * len(levels), abs=0.05 * len(levels))


@pytest.mark.parametrize("mode", ["fault", "estop"])
@pytest.mark.parametrize(("tick", "rate"), [(0.05, 5.0), (0.2, 2.5)])
def test_the_light_flickers_after_a_fault(
    pins: Pins, panel: RpiGpioPanel, mode: str, tick: float, rate: float
) -> None:
    levels = record_light(pins, panel, mode, tick, 10.0)
    assert count_flashes(levels) == pytest.approx(10.0 * rate, rel=0.15)


def test_close_ends_the_light_and_gives_back_only_its_pins(pins: Pins, panel: RpiGpioPanel) -> None:
    from RPi import GPIO

    GPIO.setup(22, GPIO.OUT, initial=GPIO.HIGH)
    presses = []
    panel.on_press = lambda: presses.append(1)
    panel.update("running", 0.0)
    panel.close()
    panel.close()
    assert pins.lines[LIGHT].driven == 0
    assert not pins.lines[LIGHT].is_output
    assert pins.lines[22].level() == 1
    pins.set_level(BUTTON, OPEN)
    assert presses == []


def test_close_goes_on_when_a_step_fails(
    pins: Pins, panel: RpiGpioPanel, caplog: pytest.LogCaptureFixture
) -> None:
    from RPi import GPIO

    GPIO.cleanup(LIGHT)  # by another part of the program
    panel.close()
    assert caplog.messages[0].startswith("cannot switch off GPIO 27: ")
    assert pins.lines[BUTTON].pull == PULL_NONE


def test_without_pins_no_library_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "RPi", None)
    panel = RpiGpioPanel(PanelSettings(), VirtualClock())
    assert panel.update("running", 0.0) is False
    panel.close()
