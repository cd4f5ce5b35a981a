"""The real fishctl with the real daemon: every verb, and its error messages."""

import json
import socket
from pathlib import Path

import pytest
from rigs.processes import Daemon, Subscriber, one_line, running


def test_the_command_of_the_mission_works(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        done = daemon.fishctl("set-controller", "swing", "--C", "0.6")
        assert (done.returncode, done.stderr) == (0, "")
        assert "running: swing C=0.6" in done.stdout
        tick = subscriber.until(controller="swing", mode="running")
        assert abs(tick["phi_c"]) == 0.42


def test_a_change_holds_from_the_tick_that_the_reply_names(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        subscriber.message()
        state = json.loads(daemon.fishctl("set-controller", "square", "--json").stdout)
        while (tick := subscriber.message())["seq"] < state["seq"]:
            assert tick["controller"] == "hold"
    assert (tick["seq"], tick["controller"]) == (state["seq"], "square")


@pytest.mark.parametrize(
    "words",
    [
        ("C", "0.4", "longest-half-period", "0.8"),
        ("C=0.4", "longest-half-period=0.8"),
        ("C=0.4", "longest_half_period", "0.8"),
        ("--C=0.4", "--longest-half-period", "0.8"),
    ],
    ids=" ".join,
)
def test_parameters_change_together_or_not_at_all(daemon: Daemon, words: tuple[str, ...]) -> None:
    daemon.fishctl("set-controller", "swing", "--C", "0.6")
    done = daemon.fishctl("set-parameter", *words)
    assert done.stderr == ""
    assert "C=0.4 amplitude=default longest_half_period=0.8 s" in done.stdout
    done = daemon.fishctl("set-parameter", "C", "0.2", "longest_half_period", "-1")
    assert done.returncode == 1
    assert "longest_half_period: -1.0 is not valid: a number in (0, 10] s is needed" in done.stderr
    done = daemon.fishctl("set-parameter", "frequency", "2")
    assert done.stderr.startswith("fishctl: unknown parameter 'frequency' of controller swing; ")
    assert done.stderr.endswith(" [bad-parameter]\n")
    done = daemon.fishctl("set-parameter", "C=0.5", "amplitude=24deg")
    assert "Invalid value for 'amplitude': '24deg' is not valid: a number in" in done.stderr
    assert daemon.status().parameters["C"] == 0.4


@pytest.mark.parametrize("word", ["--C=0.4", "C=0.4"])
def test_a_parameter_may_be_given_without_dashes(daemon: Daemon, word: str) -> None:
    done = daemon.fishctl("set-controller", "swing", word, "longest_half_period=0.8")
    assert "swing C=0.4 amplitude=default longest_half_period=0.8 s" in done.stdout
    done = daemon.fishctl("set-controller", "swing", "D=0.4")
    assert "No such option '--D'" in done.stderr


def test_stop_estop_and_clear_fault_do_what_they_say(daemon: Daemon) -> None:
    daemon.fishctl("set-controller", "square")
    with Subscriber(daemon.telemetry, b"tick") as subscriber:
        assert daemon.fishctl("stop").stdout.startswith("idle: hold")
        subscriber.until(mode="idle", phi_c=0.0, servo_on=True)
        assert "estop (leak): hold" in daemon.fishctl("estop", "leak").stdout
        subscriber.until(mode="estop", servo_on=False)
        refused = daemon.fishctl("set-controller", "square")
        assert refused.returncode == 1
        assert refused.stderr == (
            "fishctl: fishd is in estop: leak; mend the cause, then clear it with "
            "'fishctl clear-fault' [estop]\n"
        )
        assert daemon.fishctl("clear-fault").stdout.startswith("idle: hold")
        subscriber.until(mode="idle", servo_on=True)


def test_controllers_are_listed_with_parameters_units_ranges_and_defaults(daemon: Daemon) -> None:
    text = daemon.fishctl("controllers").stdout
    assert "swing  Reverse the tail" in text
    assert "--longest-half-period" in text
    assert "A number in (0, 10] s; default 1.0." in text
    listed = json.loads(daemon.fishctl("controllers", "--json").stdout)
    known = {info["name"]: info for info in listed}
    assert {"hold", "square", "sine", "triangle", "swing"} <= set(known)
    assert known["swing"]["parameters"][0] == {
        "name": "C",
        "kind": "number",
        "unit": "1",
        "description": "Reverse when the fin's speed falls to C times its last maximum; auto: "
        "begin with 0.6, and search for the largest thrust.",
        "default": 0.6,
        "low": 0.0,
        "high": 1.0,
        "step": 0.05,
        "optional": False,
        "words": ["auto"],
    }


def test_the_status_says_what_runs_and_how_well(daemon: Daemon) -> None:
    daemon.fishctl("set-controller", "sine", "--frequency", "1.5")
    text = daemon.fishctl("status").stdout
    rows = [line.split()[0] for line in text.splitlines()]
    assert rows[:5] == ["fish", "mode", "controller", "angle", "thrust"]
    assert "sine frequency=1.5" in text
    assert not {"loop", "duration", "estimate"} & set(rows)
    with_timing = daemon.fishctl("status", "--timing").stdout
    for word in ("running", "loop ", "lateness ", "duration ", "estimate "):
        assert word in with_timing


def test_a_fault_is_shown_with_what_to_do_about_it(daemon: Daemon) -> None:
    daemon.fishctl("estop", "leak")
    lines = daemon.fishctl("status").stdout.splitlines()
    assert lines[1:3] == [
        "mode        estop (leak)",
        "to do       make sure that the fish may move again "
        "(docs/how-to/troubleshooting.md, estop); then: fishctl clear-fault",
    ]


def test_a_fish_has_a_name_which_tells_two_daemons_apart(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    named = ("--set", "name=left tank")
    with running(tmp_path, *named) as left, running(tmp_path / "other") as unnamed:
        assert left.fishctl("status").stdout.startswith("fish        left tank, simulated\n")
        assert "  left tank  idle" in left.fishctl("watch", "--seconds", "5").stdout
        with Subscriber(left.telemetry, b"status") as subscriber:
            assert subscriber.message()["name"] == "left tank"
        assert unnamed.status().name == socket.gethostname()[:40]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("set-controller", "swin"), "no controller is named 'swin'; did you mean 'swing'?"),
        (("set-controller", "swing", "--C", "2"), "swing: C: 2.0 is not valid: a number in [0, 1]"),
        (("set-controller", "sine", "--speed", "1"), "No such option"),
        (("set-parameter", "C", "0.4"), "no controller is running (mode idle)"),
        (("set-parameter", "C"), "every NAME needs a VALUE, such as: C 0.7, or C=0.7"),
        (
            ("optimise", "square"),
            "no parameter has a range: give one, such as --frequency",
        ),
        (("set-parameter", "C=0.7", "x"), "every NAME needs a VALUE"),
        (("set-parameter", "C", "0.7", "C=0.3"), "C is given twice"),
        (("status", "--endpoint", "nonsense"), "'nonsense' is not an address"),
        (("mark", "a\nb\x1b[2J"), "a text of up to 1000 printable characters is needed"),
        (("mark", "x" * 70_000), "mark: the request is longer than 16384 bytes"),
        (("estop", "line\nline"), "a text of up to 1000 printable characters is needed"),
    ],
)
def test_a_mistake_gets_one_line(daemon: Daemon, arguments: tuple[str, ...], message: str) -> None:
    done = daemon.fishctl(*arguments)
    assert done.returncode in (1, 2)
    assert message in one_line(done)
    assert done.stderr.startswith("fishctl: ")


def test_the_configuration_can_be_checked_shown_and_explained(daemon: Daemon) -> None:
    shown = daemon.fishctl("config", "show", "--set", "plant.xi=0.5").stdout
    assert "  xi: 0.5" in shown
    running = json.loads(daemon.fishctl("config", "show", "--running", "--json").stdout)
    assert running["control"]["address"] == daemon.endpoint
    done = daemon.fishctl("config", "show", "--running", "--set", "plant.xi=0.5")
    assert done.returncode == 2
    schema = json.loads(daemon.fishctl("config", "schema").stdout)
    assert "tick" in schema["$defs"]["Config"]["properties"]
    done = daemon.fishctl("config", "check", "nowhere.yaml")
    assert (done.returncode, done.stderr[:30]) == (78, "fishctl: nowhere.yaml: no such")
