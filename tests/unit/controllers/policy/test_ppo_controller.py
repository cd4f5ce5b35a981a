"""The controller `ppo`: a policy in the loop, and which policies it refuses."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from onnx import TensorProto, helper, numpy_helper
from rigs.harness import LIMITS, Rig, observe
from rigs.policy_files import answer, card, linear, of_nodes, random_layers, write
from rigs.processes import FISHCTL, call

from fishd.config import load
from fishd.controllers import registry
from fishd.controllers.base import Controller, Limits
from fishd.controllers.policy.card import Card
from fishd.controllers.policy.network import to_onnx
from fishd.core.errors import ConfigError, ParameterError


def create_policy(path: Path, limits: Limits = LIMITS) -> Controller[Any]:
    return registry.create("ppo", {"policy": str(path)}, limits)


def refusal(path: Path | str, limits: Limits = LIMITS) -> str:
    with pytest.raises(ParameterError) as caught:
        registry.check("ppo", {"policy": str(path)}, limits)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_policy_in_the_loop_gives_exactly_the_angles_of_its_network(tmp_path: Path) -> None:
    # -0.5·φ_c/Φ + 0.25: from neutral φ_c/Φ goes 1/4, 1/8, 3/16, ..., all of them exact.
    path = write(tmp_path, to_onnx(linear(-0.5, bias=0.25), "tanh", card()))
    rig = Rig("slew_limit=null").start("ppo", policy=str(path))
    angles = [tick.phi_c for tick in rig.run(5)]
    # The input is float32, so that φ_c/Φ comes back rounded to that.
    assert angles == pytest.approx([0.42 * x for x in (1 / 4, 1 / 8, 3 / 16, 5 / 32, 11 / 64)])
    assert angles[0] == 0.42 * 0.25
    assert rig.mode == "running"


def test_what_the_network_sees_is_each_feature_over_its_scale(tmp_path: Path) -> None:
    features = (("fy", 0.02), ("fy_rate", 0.3), ("fin_velocity", 0.002), ("fx", 0.026))
    layers = random_layers(4, 16, 1)
    rig = Rig("simulation.noise=1e-3", "simulation.seed=1", "chatter.dwell=0")
    path = write(tmp_path, to_onnx(layers, "tanh", card(*features)))
    rig.start("ppo", policy=str(path))
    for tick in rig.run(200):
        seen = np.array([tick.fy / 0.02, tick.fy_rate / 0.3, tick.fin_velocity / 0.002])
        wanted = answer(layers, "tanh", np.append(seen, tick.fx / 0.026))
        assert tick.phi_c == pytest.approx(0.42 * wanted, abs=1e-6)


WATER = "readings.water_temperature"


def test_a_policy_sees_the_readings_of_its_card_and_keeps_those_that_are_old(
    tmp_path: Path,
) -> None:
    path = write(tmp_path, to_onnx(linear(1.0), "tanh", card((WATER, 10.0, 20.0))))
    rig = Rig("sensors.w={kind: simulated, value: 22, amplitude: 0}", "slew_limit=null")
    rig.start("ppo", policy=str(path))
    ticks = rig.run(3)
    assert ticks[0].readings.keys() == {"power"}  # it has no sample yet, and the fish is pushed
    assert [tick.phi_c for tick in ticks[1:]] == pytest.approx([0.42 * 0.2] * 2)
    (sensor,) = (sensor for sensor in rig.loop.readings.sensors if sensor.name == "w")
    sensor.stale_after = -1.0
    tick = rig.run(3)[-1]
    assert tick.readings.keys() == {"power"}
    assert tick.phi_c == pytest.approx(0.42 * 0.2)


def test_a_policy_for_readings_that_a_fish_lacks_is_refused_with_those_that_it_has(
    tmp_path: Path,
) -> None:
    path = write(tmp_path, to_onnx(linear(1.0), "tanh", card((WATER, 10.0, 20.0))))
    assert refusal(path, load(None, ["sensors.flow={kind: simulated, name: flow}"]).limits) == (
        f"ppo: policy: {path}: it needs the reading water_temperature, which this robot does not "
        "have; it has power, flow: add a sensor to sensors, or rename one of its readings"
    )
    create_policy(path)  # a client does not know the readings of the fish


@pytest.mark.parametrize("bias", [0.0, 1e-7])
def test_an_offset_of_fx_does_not_keep_a_fish_at_rest(tmp_path: Path, bias: float) -> None:
    # The network has left-right symmetry: its output is zero, up to rounding, where fy is zero.
    content = to_onnx(linear(0.0, 1.0, bias=bias), "tanh", card(("fx", 0.026), ("fy", 0.4)))
    rig = Rig("simulation.noise=0", "simulation.offset_x=0.01", "slew_limit=null")
    rig.start("ppo", policy=str(write(tmp_path, content)))
    assert next(tick.phi_c for tick in rig.run(1)) == 0.42


def test_a_policy_for_a_smaller_amplitude_stays_within_it(tmp_path: Path) -> None:
    path = write(tmp_path, to_onnx(linear(-9.0, bias=9.0), "tanh", card(amplitude=0.2)))
    rig = Rig().start("ppo", policy=str(path))
    assert max(tick.phi_c for tick in rig.run(10)) == 0.2


def root_of_what_is_left(largest: float, about: Card) -> bytes:
    """√(largest − x): not a number beyond."""
    left = helper.make_node("Sub", ["largest", "observation"], ["left"])
    root = helper.make_node("Sqrt", ["left"], ["action"])
    weight = numpy_helper.from_array(np.array([[largest]], np.float32), "largest")
    return of_nodes([left, root], [weight], about)


def test_an_output_that_is_not_finite_in_the_tick_is_a_fault_at_neutral(tmp_path: Path) -> None:
    # No probe is that large, but with this scale an angle of 0.42 rad is.
    content = root_of_what_is_left(1e6, card(("instruction_angle", 1e-8)))
    rig = Rig().start("ppo", policy=str(write(tmp_path, content)))
    first, *_, last = rig.run(20)
    assert first.phi_c == 0.42  # √1e6, cut to 1
    assert (rig.mode, rig.reason) == ("fault", "controller-error")
    assert "the instruction angle is nan, not a finite number" in rig.loop.supervisor.reason.message
    assert (last.controller, last.phi_c) == ("hold", 0.0)


def test_a_policy_whose_output_is_not_finite_for_some_input_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, root_of_what_is_left(0.5, card()))
    message = refusal(path)
    assert message.startswith(f"ppo: policy: {path}: its output is not finite for the input [")
    assert message.endswith("; train it again, or export an earlier checkpoint")


def test_a_model_that_onnxruntime_cannot_run_is_refused(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Cast", ["observation"], ["short"], to=TensorProto.BFLOAT16),
        helper.make_node("Tanh", ["short"], ["bent"]),  # there is none for such numbers
        helper.make_node("Cast", ["bent"], ["action"], to=TensorProto.FLOAT),
    ]
    path = write(tmp_path, of_nodes(nodes))
    assert refusal(path).startswith(f"ppo: policy: {path}: onnxruntime cannot run it: ")


def test_another_tick_and_an_amplitude_beyond_the_robots_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert refusal(path, Limits(amplitude=0.42, tick=0.02)) == (
        f"ppo: policy: {path}: it was trained at a tick of 50 ms, this robot's is 20 ms; "
        "set tick: 0.05, or train one at this tick"
    )
    create_policy(path, Limits(amplitude=0.42, tick=0.05 + 1e-12))
    assert refusal(path, Limits(amplitude=0.4, tick=0.05)) == (
        f"ppo: policy: {path}: it commands up to ±0.42 rad, beyond the robot's amplitude_limit, "
        "0.4 rad; set amplitude_limit: 0.42, or train one for less"
    )


def test_a_policy_must_be_given() -> None:
    with pytest.raises(ParameterError, match=r"ppo: policy: is missing: a name or the path of a"):
        registry.check("ppo", {}, LIMITS)


def test_the_policy_does_not_change_in_flight(tmp_path: Path) -> None:
    rig = Rig().start("ppo", policy=str(write(tmp_path)))
    rig.run()
    with pytest.raises(ParameterError, match="it cannot change while ppo is active"):
        rig.retune(policy=str(write(tmp_path, name="other")))
    assert rig.mode == "running"


def test_what_is_run_is_what_was_checked(tmp_path: Path) -> None:
    path = write(tmp_path)
    policy = create_policy(path)
    path.write_bytes(b"something else by now")
    assert policy.update(observe(0.42)) == -0.42


def test_a_configuration_can_start_with_a_policy_or_says_why_not(tmp_path: Path) -> None:
    path = write(tmp_path)
    rig = Rig("start.controller=ppo", f"start.parameters.policy={path}", "chatter.dwell=0")
    assert (rig.mode, rig.run(2)[-1].phi_c) == ("running", -0.42)
    with pytest.raises(ConfigError, match=r"tick of 50 ms, this robot's is 20 ms"):
        load(None, ("start.controller=ppo", f"start.parameters.policy={path}", "tick=0.02"))


@pytest.mark.parametrize("package", ["onnx", "onnxruntime"])
def test_a_fishd_without_the_extra_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, package: str
) -> None:
    path = write(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
    message = refusal(path)
    assert message.startswith(f"ppo: policy: {path}: it cannot be ")
    assert f": {package} is not installed: install fishd[policy], or onnx and onnx" in message


@pytest.mark.slow
def test_what_runs_the_network_leaves_nothing_in_the_users_folder(tmp_path: Path) -> None:
    path = write(tmp_path, to_onnx(linear(0.5), "tanh", card()))
    home = tmp_path / "home"
    home.mkdir()
    environment = {**os.environ, "HOME": str(home), "XDG_CACHE_HOME": "", "XDG_STATE_HOME": ""}
    run = call(FISHCTL, "simulate", "ppo", "--policy", str(path), env=environment)
    assert (run.returncode, run.stderr) == (0, "")
    assert list(home.iterdir()) == []


def test_a_policy_that_never_saw_a_velocity_in_rad_per_second_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, to_onnx(linear(1.0), "tanh", card(("fin_velocity", 0.002))))
    refused = refusal(path, replace(LIMITS, scaled=True))
    assert "trained with the fin_velocity of estimator.kind: lateral_force" in refused
