"""The packages in docs/example-drivers, installed and used as their reader would."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from msgspec import UNSET
from rigs.example_packages import (
    BUS,
    MILLIVOLTS_PER_NEWTON,
    DepthRig,
    LoadCellRig,
    ServoBoardRig,
    fishctl,
)
from rigs.hx711_chip import GpioStandIn, Hx711Chip
from rigs.pca9685_chip import AUTO_INCREMENT, LED0, MODE1, PRE_SCALE, RESTART, SLEEP, Pca9685Chip

from fishd import assembly
from fishd.config import load
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import VirtualClock
from fishd.core.errors import ConfigError, ServoError, StartupError
from fishd.core.process import kernel_names
from fishd.hardware import ownership
from fishd.hardware.driver import Pair
from fishd.hardware.sampler import Sampler
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import I2cBus
from fishd.virtual.pi.linux_i2c import LinuxI2c

pytestmark = pytest.mark.slow

EXAMPLES = "example-drivers"
VOLTS = {"x": 1e-3, "y": -2e-3}
THRUST = 0.026
"""Mean thrust of a square wave of 1.7 Hz on the default fish [N]."""


def options(*settings: str) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


def doctor(site: Path, folder: Path, *settings: str) -> dict[str, dict[str, str]]:
    mine = options(*settings, f"state_folder={folder}", f"telemetry.address=ipc://{folder}/t")
    done = fishctl(site, "--endpoint", f"ipc://{folder}/nobody", "doctor", "--json", *mine)
    return {line["check"]: line for line in json.loads(done.stdout)}


class LoadCells:
    """Two HX711 on the pins of the defaults, and the driver on them."""

    def __init__(self, driver: Any, **settings: Any) -> None:
        self.clock = VirtualClock()
        self.volts = dict(VOLTS)
        rate = float(settings.get("rate", 80))
        self.chips = [
            Hx711Chip(self.clock, lambda *_: self.volts["x"], rate),
            Hx711Chip(self.clock, lambda *_: self.volts["y"], 0.97 * rate),
        ]
        self.gpio = GpioStandIn(self.clock, 5, {6: self.chips[0], 13: self.chips[1]})
        self._make = lambda: driver.Hx711(driver.Hx711Settings(**settings), self.clock)

    def run(self, seconds: float) -> list[Pair]:
        """Return the pairs that arrive during a time [s]."""
        self.sampler.samples.clear()
        until = self.clock.now + seconds
        while self.clock.now < until:
            self.sampler.step()
        return list(self.sampler.samples)

    def __enter__(self) -> "LoadCells":
        self.gpio.__enter__()
        self.sampler = Sampler(self._make(), self.clock)
        return self

    def __exit__(self, *_: object) -> None:
        self.sampler.close()
        self.gpio.__exit__()
        assert not self.gpio.claimed


@pytest.fixture
def load_cells(_installed: None) -> Callable[..., LoadCells]:
    import fishd_hx711

    return lambda **settings: LoadCells(fishd_hx711, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("gain", [128, 64])
@pytest.mark.parametrize(("x", "y"), [(1e-3, -2e-3), (-15e-3, 15e-3), (0.0, -1e-9)])
def test_hx711_codes_of_24_bits_become_voltages_at_the_gain_that_was_asked_for(
    load_cells: Callable[..., LoadCells], gain: int, x: float, y: float
) -> None:
    with load_cells(gain=gain) as rig:
        rig.volts.update(x=x, y=y)
        pairs = rig.run(1.0)
        assert {gain} == {used for chip in rig.chips for _, used in chip.conversions[1:]}
    assert len(pairs) == pytest.approx(76, abs=8)  # as the slower of the two delivers
    step = 0.5 * 4.3 / gain / 2**23
    for pair in pairs:
        assert (pair.vx, pair.vy) == pytest.approx((x, y), abs=step)
        assert not pair.clipped


def test_hx711_a_pulse_that_lasts_too_long_costs_a_start_and_no_wrong_sample(
    load_cells: Callable[..., LoadCells],
) -> None:
    with load_cells(gain=64) as rig:
        rig.run(0.5)
        rig.gpio.hold_up = 70e-6
        begun = rig.clock.now
        pairs = rig.run(1.0)
        assert rig.sampler.errors == 0
    assert pairs[0].time - begun > 0.05  # the chips settle first
    assert all((p.vx, p.vy) == pytest.approx((1e-3, -2e-3), abs=1e-8) for p in pairs)


def test_hx711_a_wire_that_is_off_is_named_till_back(load_cells: Callable[..., LoadCells]) -> None:
    with load_cells() as rig:
        rig.run(0.5)
        rig.gpio.unplugged.add(13)
        assert not rig.run(1.0)[1:]
        assert rig.sampler.trouble.startswith("no data from the HX711 on GPIO 13: check its power")
        rig.gpio.unplugged.clear()
        assert rig.run(2.0)
        assert rig.sampler.trouble is None
        rig.gpio.shorted.add(6)
        rig.run(0.5)
        assert "is its DOUT shorted to ground?" in rig.sampler.trouble


def test_hx711_the_end_of_its_range_is_told(load_cells: Callable[..., LoadCells]) -> None:
    with load_cells() as rig:
        rig.volts["y"] = -1.0
        assert rig.run(0.5)[-1].clipped == "F_y (GPIO 13) is at the end of its range"


@pytest.mark.usefixtures("_installed")
def test_hx711_a_fish_swims_on_it(tmp_path: Path) -> None:
    from fishd.core.calibration import ForceCalibration

    newton = 1e3 / MILLIVOLTS_PER_NEWTON
    with ExitStack() as stack:
        rig = LoadCellRig(tmp_path, stack, "force_sensor.driver=hx711")
        assert rig.robot.calibrated
        sensor = rig.robot.calibrated.sensor
        sensor.recalibrate(ForceCalibration(xx=newton, yy=newton))
        rig.start("square", frequency=1.7)
        rig.run_for(3.0)
        ticks = rig.run_for(10.0)
        assert rig.mode == "running"
        assert sensor.counters() == {"sensor_errors": 0, "sensor_reconnects": 0}
    assert sum(tick.fx for tick in ticks) / len(ticks) == pytest.approx(THRUST, rel=0.05)
    assert min(tick.samples for tick in ticks) >= 3


@pytest.mark.usefixtures("_installed")
@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ("rate=10", "longer than a tick of 50 ms"),
        ("rate=20", "one of 10 | 80 1/s is needed"),
        ("data_y=6", "6 is the pin of data_x already"),
        ("data_x=18", "GPIO 18 is already used by force_sensor.data_x"),
        ("clok=3", "did you mean 'clock'?"),
        ("address=72", "unknown key with driver hx711; drivers that have it: ads1115"),
    ],
)
def test_hx711_a_wrong_setting_is_refused_by_key(setting: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, ["robot=pi", "force_sensor.driver=hx711", f"force_sensor.{setting}"])
    assert complaint in str(refusal.value)
    assert "\n" not in str(refusal.value)


HX711 = [
    "force_sensor.driver=hx711",
    *("force_sensor.clock=25", "force_sensor.data_x=26", "force_sensor.data_y=27"),
    "servo.host=127.0.0.2",
]
PCA9685 = ["servo.driver=pca9685", "servo.bus=177", "force_sensor.bus=178"]


@pytest.mark.usefixtures("_installed")
@pytest.mark.parametrize(
    ("settings", "part", "complaint"),
    [
        (HX711, 0, r"drives the HX711's PD_SCK on GPIO 25; .*sensor\.clock"),
        (PCA9685, 1, r"drives /dev/i2c-177; end it.* another servo\.bus"),
    ],
    ids=["hx711", "pca9685"],
)
def test_a_second_fishd_on_the_same_chip_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: list[str], part: int, complaint: str
) -> None:
    monkeypatch.setattr(kernel_names, "_PREFIX", f"test-{os.getpid()}")
    config = load(None, ["robot=pi", *settings, f"state_folder={tmp_path}"])
    with (
        ownership.claim_parts(assembly.parts_of(config)[part : part + 1]),
        ExitStack() as stack,
        pytest.raises(StartupError, match=complaint),
    ):
        assembly.open_robot(config, VirtualClock(), stack)


class ServoBoard:
    """A PCA9685 on an emulated bus, and servos on it."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver
        self.clock = VirtualClock()
        self.faults = Faults(self.clock)
        self.bus = I2cBus(self.clock, 400e3, self.faults)
        self.chip = Pca9685Chip(self.clock, channel=3)
        self.bus.attach(0x41, self.chip)
        self.device = LinuxI2c(self.bus.transfer, {BUS}, lambda seconds: None)

    def settings(self, **settings: Any) -> Any:
        return self.driver.Pca9685Settings(bus=BUS, address=0x41, channel=3, **settings)

    def servo(self, **settings: Any) -> CalibratedServo:
        return CalibratedServo(
            self.driver.Pca9685,
            self.settings(**settings),
            ServoCalibration(),
            self.clock,
            threaded=False,
            tick=0.05,
        )

    def last_resort(self) -> bool:
        resort = self.driver.Pca9685.last_resort(self.settings())
        return bool(self.driver.neutralise(1500.0, **resort.arguments, sleep=self.clock.sleep))

    @property
    def width(self) -> float:
        """Pulse width from the next frame on [µs]."""
        self.clock.sleep(0.03)
        return self.chip.width(self.clock.now)


@pytest.fixture
def board(_installed: None) -> Iterator[ServoBoard]:
    import fishd_pca9685

    board = ServoBoard(fishd_pca9685)
    with board.device:
        yield board


@pytest.mark.parametrize("frequency", [50.0, 100.0, 333.0])
def test_pca9685_an_angle_is_a_pulse_to_half_a_count(board: ServoBoard, frequency: float) -> None:
    servo = board.servo(frequency=frequency)
    for angle, pulse in ((0.0, 1500.0), (0.42, 1752.0), (-0.42, 1248.0)):
        servo.write(angle)
        assert board.width == pytest.approx(pulse, abs=0.5e6 / frequency / 4096 + 0.01 * pulse)
    assert board.chip.pulses.at(board.clock.now).frame == pytest.approx(1 / frequency, rel=0.02)
    assert board.chip.writes[-1][0] == LED0 + 4 * 3
    assert len(board.chip.writes[-1]) == 5  # ON and OFF in one transfer: never half of a pulse


def test_pca9685_opening_and_closing_change_nothing(board: ServoBoard) -> None:
    before = bytes(board.chip.registers)
    board.servo().close()
    assert bytes(board.chip.registers) == before


def test_pca9685_other_channels_go_on_at_the_new_frequency(board: ServoBoard) -> None:
    chip = board.chip
    chip.write(bytes([MODE1, AUTO_INCREMENT]))
    board.clock.sleep(1e-3)
    chip.write(bytes([LED0 + 4 * 7, 0, 0, 0x33, 0x01]))
    board.servo().write(0.0)
    assert chip.registers[PRE_SCALE] == 121
    assert chip.registers[MODE1] & (SLEEP | RESTART | AUTO_INCREMENT) == AUTO_INCREMENT
    chip.channel = 7
    chip.write(b"\x00")  # only the pointer: it sends on what the registers say
    assert board.width == pytest.approx(0x133 * 122 / 25.0)


def test_pca9685_off_and_close_end_the_pulses_and_write_begins_again(board: ServoBoard) -> None:
    servo = board.servo()
    servo.write(0.3)
    assert board.width > 0.0
    servo.release()
    servo.release()
    assert board.width == 0.0
    servo.write(0.0)
    assert board.width == pytest.approx(1500.0, abs=5.0)
    servo.close()
    servo.close()
    assert board.width == 0.0


def test_pca9685_a_bus_that_fails_is_an_error_in_words_and_opened_again(board: ServoBoard) -> None:
    servo = board.servo()
    servo.write(0.3)
    board.chip.plugged_in = False
    for _ in range(2):
        with pytest.raises(ServoError, match=r"^nothing answers at 0x41 on /dev/i2c-204: .*PCA9"):
            servo.write(0.3)
    board.chip.plugged_in = True
    servo.write(0.3)
    assert board.width == pytest.approx(1680.0, abs=5.0)
    assert servo.driver.counters() == {"servo_reconnects": 1}


@pytest.mark.parametrize("by", ["a reset", "fishctl release"])
def test_pca9685_pulses_ended_from_outside_do_not_begin_again(board: ServoBoard, by: str) -> None:
    servo = board.servo()
    servo.write(0.3)
    board.clock.sleep(0.1)
    if by == "a reset":
        board.chip.power_cycle()
    else:
        assert board.last_resort()
    with pytest.raises(ServoError, match="switched off from outside"):
        servo.write(0.3)
    assert board.width == 0.0


def test_pca9685_the_last_resort_goes_to_neutral_and_ends_the_pulses(board: ServoBoard) -> None:
    assert board.last_resort() is False
    board.servo().write(0.5)
    assert board.width == pytest.approx(1800.0, abs=5.0)
    begun = board.clock.now
    assert board.last_resort() is True
    board.clock.sleep(0.03)
    history = [(when, round(width, -1)) for when, width in board.chip.pulses.history]
    (neutral, width), (off, none) = history[-2:]
    assert (width, none) == (1500, 0)
    assert neutral - begun < 0.03
    assert 0.28 < off - neutral < 0.33


def test_pca9685_the_last_resort_ends_pulses_though_neutral_is_refused(board: ServoBoard) -> None:
    board.servo().write(0.5)
    board.chip.refused = {(LED0 + 4 * 3, 0)}
    with pytest.raises(ServoError, match="nothing answers"):
        board.last_resort()
    assert board.width == 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("_installed")
def test_pca9685_a_fish_swims_on_it_beside_the_force_sensor_on_its_bus(tmp_path: Path) -> None:
    settings = ["servo.driver=pca9685", f"servo.bus={BUS}", f"force_sensor.bus={BUS}"]
    with ExitStack() as stack:
        rig = ServoBoardRig(tmp_path, stack, *settings)
        rig.start("square", frequency=1.7)
        rig.run_for(3.0)
        ticks = rig.run_for(10.0)
        assert rig.mode == "running"
        assert min(tick.samples for tick in ticks) >= 10
        widths = {round(width / 10) * 10 for _, width in rig.board.pulses.history if width}
        rig.loop.stop()
        rig.run_for(1.0)
        assert rig.board.width(rig.clock.now) == pytest.approx(1500.0, abs=5.0)
    assert {1250, 1750} <= widths
    assert min(widths) >= 1240
    assert max(widths) <= 1760
    assert sum(tick.fx for tick in ticks) / len(ticks) == pytest.approx(THRUST, rel=0.05)


@pytest.mark.usefixtures("_installed")
def test_keller_ld_its_readings_are_in_ticks_status_and_observations(tmp_path: Path) -> None:
    with ExitStack() as stack:
        rig = DepthRig(tmp_path, stack, "sensors.depth.kind=keller_ld")
        rig.start("square", frequency=1.7)
        ticks = rig.run_for(3.0)
        expected = {"pressure": pytest.approx(101_325, abs=100), "water_temperature": 21.35}
        assert ticks[-1].readings == pytest.approx(expected)
        assert rig.loop.perception.observation.readings == ticks[-1].readings
        assert rig.loop.readings.states(rig.clock.now)["pressure"].unit == "Pa"
        rig.keller.plugged_in = False
        assert {tick.readings for tick in rig.run_for(2.0)[-20:]} == {UNSET}
        assert rig.mode == "running"
        rig.keller.plugged_in = True
        assert rig.run_for(2.0)[-1].readings == pytest.approx(expected)


def test_doctor_names_both_with_their_checks_and_release_works(site: Path, tmp_path: Path) -> None:
    servo = ["robot=pi", "servo.driver=pca9685", f"servo.bus={BUS}"]
    checks = doctor(site, tmp_path, "force_sensor.driver=hx711", *servo)
    used = "force_sensor hx711 of fishd-hx711 0.1.0, servo pca9685 of fishd-pca9685 0.1.0"
    assert checks["drivers"]["message"] == used
    assert checks["load cells"]["message"] == "±16.8 mV at a gain of 128, 80 per second"
    assert checks["force"]["level"] == "FAIL"  # this machine has no GPIO pins
    assert "adc" not in checks
    assert checks["pca9685"]["level"] == "FAIL"
    assert f"/dev/i2c-{BUS} does not exist" in checks["pca9685"]["message"]
    done = fishctl(site, "release", *options(*servo, f"state_folder={tmp_path}"))
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(f"fishctl: /dev/i2c-{BUS} does not exist")
    assert done.stderr.count("\n") == 1


def test_doctor_says_what_a_sensor_of_another_package_reads_or_why_not(
    site: Path, tmp_path: Path
) -> None:
    sensor = ["robot=pi", "sensors.depth.kind=keller_ld", f"sensors.depth.bus={BUS}"]
    checks = doctor(site, tmp_path, *sensor)
    assert "sensors.depth keller_ld of fishd-keller-ld 0.1.0" in checks["drivers"]["message"]
    assert checks["depth"]["level"] == "FAIL"
    assert f"/dev/i2c-{BUS} does not exist" in checks["depth"]["message"]


def test_a_driver_whose_package_is_not_installed_is_one_line() -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, ["servo.driver=pca9685"])
    assert str(refusal.value).endswith(
        "no servo driver is named 'pca9685'; installed: pigpio, rpi-gpio, sysfs-pwm; for another "
        "one, install its package"
    )
