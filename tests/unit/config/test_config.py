"""Configuration: accepted files, and the messages for refused files."""

import json
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs.documents import ROOT

from deb.package import CONFIGS
from fishd.config import SERVICE_FILE, Config, load, mistakes, to_yaml
from fishd.core.errors import ConfigError
from fishd.core.strict_yaml import YamlProblem, dump, parse
from fishd.hardware.registry import SERVOS

WITH_FREQUENCY = [
    name for name in SERVOS.names() if "frequency" in SERVOS.find(name).Settings.__struct_fields__
]
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 7)
)
"""YAML in which each line has nine times the values of the line before."""


def error_message(text: str, tmp_path: Path) -> str:
    """Return the message for a file with this text."""
    file = tmp_path / "fish.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load(file)
    message = str(caught.value)
    assert "\n" not in message
    assert message in mistakes.find(file)
    return message.replace(str(tmp_path) + "/", "")


MANY_MISTAKES = """\
tik: 0.05
tick: 3
plant:
  omega: 3
  xi: on
servo:
  centre: abc
  trim: 9000
start:
  controller: swing
  parameters: {c: 1}
telemetry: {address: foo}
control: {address: 'tcp://0.0.0.0:5000'}
robot: pi
lockstep: true
panel: {estop_gpio: 18, led_gpio: 18}
tick: 4
force_sensor: {driver: ads1116}
"""
KEYS = {
    1: "tik", 2: "tick", 4: "plant.omega", 5: "plant.xi", 7: "servo.centre", 8: "servo.trim",
    11: "start.parameters.c", 12: "telemetry.address", 13: "control.address", 15: "lockstep",
    16: "panel.estop_gpio", 17: "tick", 18: "force_sensor.driver",
}  # fmt: skip
"""Wrong key by line number."""


def test_all_mistakes_of_a_file_are_found_in_the_order_of_its_lines(tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text(MANY_MISTAKES)
    listed = mistakes.find(file, ["plant.B=soft", "tick"])
    wrong = [mistake.removeprefix(f"{file}:") for mistake in listed if str(file) in mistake]
    keys = {int(line.partition(":")[0]): line.split(": ")[1] for line in reversed(wrong)}
    assert keys == KEYS
    # Both pins of line 16
    assert [int(line.partition(":")[0]) for line in wrong] == sorted([*KEYS, 16])
    keys_named = {mistake.partition(": ")[0] for mistake in listed[len(wrong) :]}
    assert keys_named == {"--set plant.B=soft", "--set tick"}


def test_a_good_file_has_no_mistakes() -> None:
    for file in (ROOT / "config").glob("*.yaml"):
        if not file.name.startswith(("camera", "learning", "window")):
            assert mistakes.find(file) == []


def test_only_values_that_were_given_are_doubted(caplog: pytest.LogCaptureFixture) -> None:
    load(None, ["start.rest=3000", "simulation.noise=0.001"])
    (record,) = caplog.records
    assert record.message == (
        "careful: --set start.rest=3000: start.rest: 3000 s is more than makes sense: up to 600 s "
        "does (ms? that is 3 s)"
    )


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("on", "on"), ("no", "no"), ("y", "y"), ("2026-11-26", "2026-11-26"), ("1_000", "1_000"),
        ("1:30", "1:30"), ("tRUE", "tRUE"), ("<<", "<<"), ("0b11", "0b11"), ("1e", "1e"),
        ("true", True), ("False", False), ("NULL", None), ("~", None),
        ("010", 10), ("0o17", 15), ("0xfF", 255), ("+5", 5), ("-0", 0),
        ("1e2", 100.0), (".5", 0.5), ("1.", 1.0), ("-1E-3", -0.001), ("-.inf", float("-inf")),
    ],
)  # fmt: skip
def test_plain_values_are_those_of_the_core_schema_of_yaml_1_2(text: str, value: object) -> None:
    data = parse(f"[{text}, '{text}']").data
    assert data == [value, text]
    assert type(data[0]) is type(value)
    assert parse(dump({"key": text})).data == {"key": text}


def test_a_section_with_nothing_below_it_takes_its_defaults(tmp_path: Path) -> None:
    file = tmp_path / "fish.yaml"
    file.write_text("plant:\n#  xi: 0.7\nstart: {controller: null, parameters: {}}\n")
    assert load(file) == Config()
    file.write_text("")
    assert load(str(file)) == Config() == load()
    assert load(None, ["slew_limit=null", "simulation.noise=1e-3"]).simulation.noise == 1e-3
    with pytest.raises(ConfigError, match=r"^nowhere\.yaml: no such file"):
        load("nowhere.yaml")


@pytest.mark.parametrize("name", ["y", "1e5", "7:30", "Fu's fish"])
def test_what_is_shown_can_be_read_back(tmp_path: Path, name: str) -> None:
    file = tmp_path / "fish.yaml"
    changes = ["plant.xi=0.7", "start.controller=swing", "start.parameters.C=0.3"]
    original = load(None, [*changes, f'name="{name}"'])
    assert original.name == name
    file.write_text(to_yaml(original), encoding="utf-8")
    assert load(file) == original


BAD_FILES = """\
tick: 0.05
plant:
  omega: 3
=> fish.yaml:3: plant.omega: unknown key; did you mean 'omega0'?

noise: 0.1
=> fish.yaml:1: noise: unknown key; did you mean 'simulation.noise'?


tick: 1
=> fish.yaml:2: tick: 1 is not valid: a number in [0.002, 0.2] s is needed

realtime: {priority: 50.5}
=> fish.yaml:1: realtime.priority: 50.5 is not valid: a whole number in [0, 99]

tick: 0.05
tick: 0.1
=> fish.yaml:2: tick: duplicate key, first given on line 1; keep one

realtime:
  lock_memory: on
=> fish.yaml:2: realtime.lock_memory: 'on' is not valid: true or false is needed

simulation:
  seed: 1e2
=> fish.yaml:2: simulation.seed: 100.0 is not valid: a whole number

plant: 3
=> fish.yaml:1: plant: 3 is not valid: a section (a mapping of keys to values)

- 1
=> fish.yaml:1: keys and values are needed, such as 'tick: 0.05'

tick: [
=> fish.yaml:2: not valid YAML

tick: 1:30
=> fish.yaml:1: tick: '1:30' is not valid: a number in [0.002, 0.2] s is needed

a: &a [*a]
=> nested too deeply

plant.xi: 2
=> plant.xi: unknown key; write 'plant:' and below it, indented, 'xi:'

control: {address: 'tcp://127.evil.com:99'}
=> accepted only from this machine

control: {address: 'ipc:///tmp/a'}
telemetry: {address: 'ipc:///tmp/a'}
=> fish.yaml:1: control.address: 'ipc:///tmp/a' is already the address of telemetry

start: {controller: swim}
=> fish.yaml:1: start.controller: no controller is named 'swim'; did you mean 'swing'?

start:
  controller: swing
  parameters:
    c: 0.5
=> fish.yaml:4: start.parameters.c: unknown parameter 'c' of controller swing; did you mean 'C'?

start: {parameters: {C: 1}}
=> start.controller is not set; set it

telemetry: {address: localhost}
=> fish.yaml:1: telemetry.address: 'localhost' is not valid: tcp://HOST:PORT or ipc://PATH is needed
"""
"""Bad files, each followed by its message."""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *(case.split("=> ") for case in BAD_FILES[:-1].split("\n\n")),
        ("a: " + "[" * 1200, "nested too deeply"),
        (BOMB, "fish.yaml:1: more than 2000 values and keys, each alias counted as all that it"),
        ("a: [" + "x, " * 3000 + "]", "fish.yaml:1: more than 2000 values and keys"),
        ("# " + "x" * 70000, "fish.yaml: is longer than 64 kB, far more than a configuration"),
        ("a: " + "1" * 200, "fish.yaml:1: a: a number of 200 characters; at most 100 are"),
    ],
)
def test_a_bad_file_gets_a_line_with_a_remedy(text: str, message: str, tmp_path: Path) -> None:
    assert message in error_message(text, tmp_path)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("plant.omega=3", "--set plant.omega=3: plant.omega: unknown key; did you mean 'omega0'?"),
        ("tick", "--set tick: write KEY=VALUE"),
        ("tick.x=3", "--set tick.x=3: "),
        ("tick=soon", "--set tick=soon: tick: 'soon' is not valid: a number in [0.002, 0.2] s"),
        ("control.address=ipc://@abstract", "'ipc://@abstract' is not valid: ipc://PATH"),
        ("control.address=tcp://[::1]:5000", "is not valid: ipc://PATH or tcp://127.0.0.1:PORT"),
    ],
)
def test_a_bad_override_is_named_as_it_was_written(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, [override])
    assert message in str(caught.value)


def test_a_bomb_of_aliases_costs_milliseconds() -> None:
    """The bomb has six levels of nine, half a million values in 300 characters."""
    costs = []
    for _ in range(3):
        started = time.process_time()
        with pytest.raises(YamlProblem):
            parse(BOMB)
        costs.append(time.process_time() - started)
    assert min(costs) < 0.2  # takes 6 ms; reading all values took half a minute


@given(st.text(max_size=60))
def test_any_text_gives_values_or_one_line_with_its_line_number(text: str) -> None:
    problem = None
    try:
        parse(text)
    except YamlProblem as error:
        problem = error
    assert problem is None or (problem.line >= 1 and "\n" not in str(problem))


@pytest.mark.parametrize(
    ("overrides", "key", "words"),
    [
        (["robot=pi", "force_sensor.full_scale=2"], "force_sensor.full_scale", "2.048"),
        (["robot=pi", "force_sensor.saturation_low=3.3"], "force_sensor.saturation_low", "3.2 V"),
        (["robot=pi", "force_sensor.channel_y=A0-A1"], "force_sensor.channel_y", "channel_x"),
        (["robot=pi", "force_sensor.data_rate=32"], "force_sensor.data_rate", "78.1 ms"),
        (["robot=pi", "tick=0.002"], "force_sensor.data_rate", "2.9 ms"),
        (["servo.centre=2300", "servo.trim=400"], "servo.trim", "2700 µs"),
        (["servo.host=my pi"], "servo.host", "'my pi' is not valid"),
        ([f"virtual_pi.socket=/tmp/{'x' * 103}"], "virtual_pi.socket", "this one has 108"),
        ([f"control.address=ipc:///tmp/{'x' * 103}"], "control.address", "at most 107 bytes"),
        ([f"telemetry.address=ipc:///tmp/{'é' * 60}"], "telemetry.address", "this one has 125"),
        (["servo.frequency=100"], "servo.frequency", f"that have it: {', '.join(WITH_FREQUENCY)}"),
        (["servo.driver=steam"], "servo.driver", f"installed: {', '.join(SERVOS.names())}"),
        (["servo.driver=3"], "servo.driver", f"one of {', '.join(SERVOS.names())}"),
        (["gpio=3"], "gpio", "did you mean 'servo.gpio'?"),
        (["panel.led_gpio=18"], "panel.led_gpio", "servo.gpio"),
        (["panel.estop_gpio=3"], "panel.estop_gpio", "force_sensor.bus"),
        (["panel.estop_gpio=5", "panel.led_gpio=5"], "panel.led_gpio", "panel.estop_gpio"),
        (["robot=virtual-pi", "servo.driver=sysfs-pwm"], "servo.driver", "pigpiod"),
        (["virtual_pi.servo_scale=0"], "virtual_pi.servo_scale", "would not turn"),
        (["state_folder=~no-such-user/fish"], "state_folder", "has no user 'no-such-user'"),
        (['state_folder="/var/\\0fish"'], "state_folder", "a path has no zero byte"),
    ],
)
def test_hardware_at_odds_is_refused_by_key(overrides: list[str], key: str, words: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, overrides)
    assert f"{key}: " in str(refusal.value)
    assert words in str(refusal.value)


def test_the_longest_path_that_a_unix_socket_takes_is_good() -> None:
    path = f"/tmp/{'x' * 102}"
    config = load(None, [f"control.address=ipc://{path}", f"virtual_pi.socket={path}"])
    assert len(config.virtual_pi.socket or "") == 107


def test_what_is_installed_on_a_pi_is_the_file_that_the_verbs_look_for() -> None:
    assert str(SERVICE_FILE) == f"/etc/fishd/{CONFIGS['pi']}.yaml"


@pytest.mark.parametrize("name", ["", " tank", "tank\n", "a\x1bb", "x" * 41])
def test_a_name_is_short_printable_text(name: str, tmp_path: Path) -> None:
    line = error_message(f"name: {json.dumps(name)}\n", tmp_path)
    assert line.startswith("fish.yaml:1: name: ")
    assert "a text of 1 to 40 printable characters (or null) is needed" in line
    assert load(None, ["name=Große Fische 2"]).name == "Große Fische 2"


def test_an_observer_of_a_robot_needs_a_plant_of_its_own(tmp_path: Path) -> None:
    text = "robot: pi\nestimator:\n  kind: observer\n"
    assert error_message(text, tmp_path) == (
        "fish.yaml:3: estimator.kind: observer needs a model of this fish, but section plant is "
        "not set; run 'fishctl identify' to write it"
    )
    file = tmp_path / "fish.yaml"
    file.write_text(text + "plant:\n  omega0: 11.2\n")
    assert load(file).limits.scaled
