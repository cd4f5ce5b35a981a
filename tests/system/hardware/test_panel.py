"""The E-stop button and the status light: the real gpiod on emulated pins."""

import errno
import sys
import threading
from collections.abc import Callable, Iterator
from itertools import chain, repeat
from pathlib import Path
from types import ModuleType

import pytest
from gpiod import _ext
from rigs.processes import PATIENCE, wait_until

from fishd.core.clock import VirtualClock
from fishd.core.errors import StartupError
from fishd.hardware.panel import Panel
from fishd.hardware.panel_pins import PanelPins, find_chip
from fishd.hardware.settings import PanelSettings
from fishd.virtual.pi import gpiochip
from fishd.virtual.pi.i2c import kernel_error

BUTTON, LIGHT = 17, 27
OPENS = PanelSettings(estop_gpio=BUTTON, estop_pressed="high", led_gpio=LIGHT)
CLOSES = PanelSettings(estop_gpio=BUTTON, estop_pressed="low")
GROUND = 0
OPEN = None  # a contact that is open, or a broken wire

TRUE = {name: getattr(_ext, name) for name in ("LineConfig", "LineSettings")}
"""Classes of gpiod's C module that the emulation replaces, and that need no chip."""

Make = Callable[[PanelSettings], Panel]


@pytest.fixture
def chip() -> Iterator[gpiochip.Pins]:
    """GPIO chip of a Pi 4, which gpiod finds."""
    chip = gpiochip.Pins()
    with gpiochip.EmulatedGpiod(chip):
        yield chip


@pytest.fixture
def make() -> Iterator[Make]:
    """Return a function that makes panels, which are closed after the test."""
    panels = []

    def make_panel(settings: PanelSettings) -> Panel:
        panels.append(Panel(settings, VirtualClock()))
        return panels[-1]

    yield make_panel
    for panel in panels:
        panel.close()


@pytest.fixture
def panel(chip: gpiochip.Pins, make: Make) -> Panel:
    """Panel whose button is released: its contact is closed."""
    chip.set_level(BUTTON, GROUND)
    return make(OPENS)


def test_a_press_is_reported_at_once_by_another_thread(chip: gpiochip.Pins, panel: Panel) -> None:
    threads = []
    panel.on_press = lambda: threads.append(threading.current_thread())
    chip.set_level(BUTTON, OPEN)
    wait_until(lambda: threads)
    assert threads != [threading.current_thread()]


def test_a_press_is_reported_once_however_it_bounces(chip: gpiochip.Pins, panel: Panel) -> None:
    presses = []
    panel.on_press = lambda: presses.append(1)
    for level in (OPEN, GROUND, OPEN, GROUND, OPEN):
        chip.set_level(BUTTON, level)
    wait_until(lambda: presses)
    for time in range(3):
        assert panel.update("estop", 0.05 * time) is True
    panel.close()  # its thread has ended: no edge is reported any more
    assert presses == [1]


def test_a_press_between_two_ticks_is_seen(chip: gpiochip.Pins, panel: Panel) -> None:
    presses = []
    panel.on_press = lambda: presses.append(1)
    panel.update("running", 0.0)
    chip.set_level(BUTTON, OPEN)
    wait_until(lambda: presses)
    chip.set_level(BUTTON, GROUND)
    assert panel.update("running", 0.05) is True
    assert panel.update("running", 0.10) is False


def test_a_release_takes_two_polls(
    chip: gpiochip.Pins, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PanelPins, "listen", lambda *_: None)  # polls alone see the button
    monkeypatch.setattr(PanelPins, "close", lambda self: self._request.release())
    panel = make(OPENS)
    assert panel.update("estop", 0.0) is True
    chip.set_level(BUTTON, GROUND)
    assert panel.update("estop", 0.05) is True
    chip.set_level(BUTTON, OPEN)
    assert panel.update("estop", 0.10) is True
    chip.set_level(BUTTON, GROUND)
    assert panel.update("estop", 0.15) is True
    assert panel.update("estop", 0.20) is False


def test_a_spike_that_is_gone_when_looked_at_is_no_press(
    chip: gpiochip.Pins, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    chip.set_level(BUTTON, GROUND)
    panel, presses, calls = make(OPENS), list[int](), list[int]()
    panel.on_press = lambda: presses.append(1)
    monkeypatch.setattr(chip, "check", lambda: calls.append(1))
    (spike,) = chip.lines[BUTTON].watchers
    for number in (1, 2):
        spike(1)  # an edge, and the level is low again
        wait_until(lambda count=2 * number: len(calls) >= count)  # it read the edge and the level
    assert presses == []  # the second spike is read after the first was judged
    assert panel.update("running", 0.0) is False


def test_a_contact_that_chatters_without_end_is_a_press(chip: gpiochip.Pins, make: Make) -> None:
    """A loose wire beside that of the servo; the kernel's debounce would never report it."""
    chip.set_level(BUTTON, GROUND)
    panel, pressed, stopped = make(OPENS), threading.Event(), threading.Event()
    panel.on_press = pressed.set

    def chatter() -> None:
        while not stopped.wait(1e-3):
            chip.set_level(BUTTON, GROUND)
            chip.set_level(BUTTON, OPEN)

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        assert pressed.wait(PATIENCE)
    finally:
        stopped.set()
        thread.join()


@pytest.mark.parametrize(
    ("settings", "released", "pressed"),
    [(OPENS, GROUND, OPEN), (CLOSES, OPEN, GROUND)],
    ids=["opens, and a broken wire is a press", "closes"],
)
def test_a_button_is_pressed_when_its_contact(
    chip: gpiochip.Pins,
    make: Make,
    settings: PanelSettings,
    released: int | None,
    pressed: int | None,
) -> None:
    chip.set_level(BUTTON, released)
    panel = make(settings)
    assert chip.lines[BUTTON].pull == gpiochip.PULL_UP
    assert panel.update("idle", 0.0) is False
    chip.set_level(BUTTON, pressed)
    assert panel.update("idle", 0.05) is True


def record_light(
    chip: gpiochip.Pins, panel: Panel, mode: str, tick: float, seconds: float
) -> list[int]:
    """Return the level of the light after each tick."""
    levels = []
    for index in range(round(seconds / tick)):
        panel.update(mode, 100.0 + index * tick)
        levels.append(chip.lines[LIGHT].level())
    return levels


def count_flashes(levels: list[int]) -> int:
    """Return how often the light went on."""
    return sum(after > before for before, after in zip([0, *levels], levels, strict=False))


@pytest.mark.parametrize("tick", [0.01, 0.2])
def test_the_light_flashes_each_second_idle(chip: gpiochip.Pins, panel: Panel, tick: float) -> None:
    levels = record_light(chip, panel, "idle", tick, 10.0)
    assert count_flashes(levels) == 10
    assert sum(levels) == pytest.approx(0.2 * len(levels), abs=0.05 * len(levels))


@pytest.mark.parametrize("mode", ["fault", "estop"])
@pytest.mark.parametrize(("tick", "rate"), [(0.05, 5.0), (0.2, 2.5)])
def test_the_light_flickers_after_a_fault(
    chip: gpiochip.Pins, panel: Panel, mode: str, tick: float, rate: float
) -> None:
    levels = record_light(chip, panel, mode, tick, 10.0)
    assert count_flashes(levels) == pytest.approx(10.0 * rate, rel=0.15)


def test_close_ends_the_light_and_the_reports(chip: gpiochip.Pins, panel: Panel) -> None:
    presses = []
    panel.on_press = lambda: presses.append(1)
    panel.update("running", 0.0)
    assert chip.lines[LIGHT].level() == 1
    panel.close()
    panel.close()
    assert chip.lines[LIGHT].driven == 0
    chip.set_level(BUTTON, OPEN)
    assert presses == []
    assert "estop-button" not in [thread.name for thread in threading.enumerate()]


def test_closed_pins_are_free_for_other_programs(chip: gpiochip.Pins, make: Make) -> None:
    panel = make(OPENS)
    assert {chip.lines[pin].consumer for pin in (BUTTON, LIGHT)} == {"fishd"}
    panel.close()
    assert {chip.lines[pin].consumer for pin in (BUTTON, LIGHT)} == {None}
    make(OPENS)


def test_a_chip_that_is_gone_is_one_error_of_the_button(
    chip: gpiochip.Pins, make: Make, caplog: pytest.LogCaptureFixture
) -> None:
    chip.set_level(BUTTON, GROUND)
    panel = make(OPENS)
    chip.error = errno.ENODEV
    chip.set_level(BUTTON, OPEN)  # as the kernel wakes all that wait for a chip that is gone
    wait_until(lambda: caplog.messages)
    for tick in range(3):
        with pytest.raises(OSError, match=r"^E-stop button on GPIO 17: No such device$"):
            panel.update("running", 0.05 * tick)
    assert sorted(caplog.messages) == [
        "E-stop button: its edges are not reported any more: No such device",
        "the status light on GPIO 27 cannot be switched any more: No such device",
    ]
    panel.close()


@pytest.mark.parametrize(
    "chips",
    [
        ("pinctrl-bcm2835", "raspberrypi-exp-gpio"),  # Pi 3, Zero 2
        ("pinctrl-bcm2711", "raspberrypi-exp-gpio"),  # Pi 4
        ("pinctrl-rp1", "gpio-brcmstb@107d508500"),  # Pi 5, kernel 6.12
        ("gpio-brcmstb@107d508500", None, None, "gpio-brcmstb@107d517c00", "pinctrl-rp1"),  # 6.6
    ],
    ids=str,
)
def test_the_chip_of_the_header_is_found_by_its_label(
    make: Make, chips: tuple[str | None, ...]
) -> None:
    pins = [label and gpiochip.Pins(label) for label in chips]
    with gpiochip.EmulatedGpiod(*pins):
        panel = make(OPENS)
        claimed = [chip.label for chip in pins if chip and chip.lines[LIGHT].consumer]
        panel.close()
    assert len(claimed) == 1
    assert claimed[0].startswith("pinctrl-")


def fail(number: int) -> None:
    if number:
        raise kernel_error(number)


class TestPinsThatCannotBeUsed:
    """Pins that cannot be used: each case gives one line with the remedy."""

    def start(self) -> str:
        with pytest.raises(StartupError) as caught:
            Panel(OPENS, VirtualClock())
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def test_of_no_pi(self) -> None:
        with gpiochip.EmulatedGpiod(gpiochip.Pins("INT33FC:00")):
            assert self.start() == (
                "the GPIO chip of the header is missing, there is only /dev/gpiochip0 "
                "(INT33FC:00); button and light need a Pi with Raspberry Pi OS"
            )
        with gpiochip.EmulatedGpiod():
            assert "is missing, there is no /dev/gpiochipN; " in self.start()

    def test_of_another_group(self, chip: gpiochip.Pins) -> None:
        chip.error = errno.EACCES
        assert self.start() == (
            "/dev/gpiochip0 may not be opened by this user; "
            "'sudo usermod -aG gpio USER', log in again, then try again"
        )

    def test_with_another_chip_that_is_forbidden(self, make: Make) -> None:
        forbidden, header = gpiochip.Pins("other"), gpiochip.Pins()
        forbidden.error = errno.EACCES
        with gpiochip.EmulatedGpiod(forbidden, header):
            make(OPENS).close()

    @pytest.mark.parametrize(
        ("pin", "consumer", "user"),
        [(BUTTON, "gpiomon", "gpiomon"), (LIGHT, "", "the kernel")],
    )
    def test_held_by_another_program(
        self, chip: gpiochip.Pins, make: Make, pin: int, consumer: str, user: str
    ) -> None:
        chip.lines[pin].consumer = consumer
        assert self.start() == (
            f"the panel cannot use its pins: GPIO {pin} is held by {user}; "
            "stop that program, remove its dtoverlay, or choose another pin"
        )
        chip.lines[pin].consumer = None
        make(OPENS)

    def test_of_a_chip_that_fails_when_it_is_asked_for_them(
        self, chip: gpiochip.Pins, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for name, true in TRUE.items():  # which refuse settings that they do not know
            monkeypatch.setattr(_ext, name, true)
        calls = chain((0, 0, 0), repeat(errno.EIO))  # after it was opened, named and opened again
        monkeypatch.setattr(chip, "check", lambda: fail(next(calls)))
        assert self.start() == (
            "the panel cannot use GPIO 17 and GPIO 27 of /dev/gpiochip0: Input/output error"
        )

    def test_with_a_gpiod_of_version_1(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Debian 12 has one as python3-libgpiod."""
        monkeypatch.setitem(sys.modules, "gpiod", ModuleType("gpiod"))
        monkeypatch.setitem(sys.modules, "gpiod.line_settings", None)
        assert self.start() == (
            "E-stop button and status light need the package gpiod, 2.3 or later; install fishd[pi]"
        )


def test_without_pins_no_library_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gpiod", "RPi"):
        monkeypatch.setitem(sys.modules, name, None)
    panel = Panel(PanelSettings(), VirtualClock())
    assert panel.update("running", 0.0) is False
    panel.close()


@pytest.mark.skipif(any(Path("/dev").glob("gpiochip*")), reason="this machine has GPIO chips")
def test_the_true_library_finds_no_chip_on_a_computer_without() -> None:
    with pytest.raises(StartupError, match=r"missing, there is no /dev/gpiochipN; "):
        find_chip()
