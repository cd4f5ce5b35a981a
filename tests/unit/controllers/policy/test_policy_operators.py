"""Refusal of policies with other operators, and of networks that are too slow."""

import re
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.inliner
import pytest
from onnx import TensorProto, helper, numpy_helper
from rigs.policy_files import card, of_nodes, random_layers, refusal, write

from fishd.controllers.policy import file
from fishd.controllers.policy.file import SEAL_REMEDY, seal
from fishd.controllers.policy.network import to_onnx
from fishd.controllers.policy.runtime import Network
from fishd.core.errors import PolicyError

make = helper.make_node
TRUE = numpy_helper.from_array(np.array(True), "true")
ENDLESS = numpy_helper.from_array(np.array(2**62), "endless")


def floats(name: str, *shape: int) -> Any:
    return numpy_helper.from_array(np.zeros(shape, np.float32), name)


def integers(name: str, *values: int) -> Any:
    return numpy_helper.from_array(np.array(values, np.int64), name)


def body(*names: str) -> Any:
    """A graph that gives its last input again and says to go on."""
    flag = helper.make_tensor_value_info("go", TensorProto.BOOL, [])
    inputs = [helper.make_tensor_value_info("number", TensorProto.INT64, []), flag]
    value = helper.make_tensor_value_info("value", TensorProto.FLOAT, [1, 1])
    nodes = [make("Identity", ["go"], ["on"]), make("Identity", ["value"], ["next"])]
    outputs = [
        helper.make_tensor_value_info("on", TensorProto.BOOL, []),
        helper.make_tensor_value_info("next", TensorProto.FLOAT, [1, 1]),
    ]
    return helper.make_graph(nodes, "body", [*inputs, value], outputs)


def test_an_endless_loop_is_refused_with_what_is_permitted() -> None:
    loop = make("Loop", ["endless", "true", "observation"], ["action"], body=body())
    began = time.process_time()
    message = refusal(of_nodes([loop], [ENDLESS, TRUE]))
    assert time.process_time() - began < 5.0
    assert message.startswith("its operator Loop is not permitted; permitted: Abs, Add, And, ")
    assert message.endswith(", Tanh, ThresholdedRelu, Transpose, Unsqueeze, Where")


@pytest.mark.parametrize(
    ("node", "named"),
    [
        (make("If", ["true"], ["action"], then_branch=body(), else_branch=body()), "If"),
        (make("Scan", ["observation"], ["action"], body=body(), num_scan_inputs=1), "Scan"),
        (make("RandomNormal", [], ["action"], shape=[1, 1]), "RandomNormal"),
        (make("Tanh", ["observation"], ["action"], domain="com.example"), "com.example.Tanh"),
        (make("\x1b[31mRed\n" * 99, ["observation"], ["action"]), r"\?\[31mRed \S+"),
    ],
)
def test_other_operators_are_refused_by_name(node: Any, named: str) -> None:
    message = refusal(of_nodes([node], [TRUE]))
    assert re.match(f"its operator {named}.* is not permitted; permitted: Abs, Add", message)
    assert message.isprintable()


def test_an_operator_that_the_file_defines_itself_is_refused() -> None:
    model = onnx.load_model_from_string(of_nodes([make("Tanh", ["observation"], ["action"])]))
    sine = make("Sin", ["x"], ["y"])
    own = helper.make_function("", "Tanh", ["x"], ["y"], [sine], [helper.make_opsetid("", 17)])
    model.functions.append(own)
    assert refusal(seal(model)) == (
        "it defines a custom operator, Tanh; replace it by those of ONNX with "
        f"onnx.inliner.inline_local_functions, and {SEAL_REMEDY}"
    )
    assert file.parse(seal(onnx.inliner.inline_local_functions(model))) == card()


@pytest.mark.parametrize("opset", [10, 99])
def test_a_version_of_the_operators_that_is_not_known_is_refused(opset: int) -> None:
    content = of_nodes([make("Tanh", ["observation"], ["action"])], opset=opset)
    assert refusal(content) == (
        f"its version of ONNX's operators: {opset}; one from 11 to 26 is needed; convert the model "
        f"with onnx.version_converter.convert_version, and {SEAL_REMEDY}"
    )


def test_more_operators_than_a_policy_needs_are_refused() -> None:
    def chain(count: int) -> bytes:
        names = ["observation", *(f"v{number}" for number in range(count - 1)), "action"]
        return of_nodes([make("Tanh", [a], [b]) for a, b in pairwise(names)])

    file.check_operators(onnx.load_model_from_string(chain(1000)))
    assert refusal(chain(1001)) == "it has 1001 operators; 1000 are the most"


@pytest.mark.parametrize(
    ("nodes", "weights", "message"),
    [
        (
            [make("Tanh", ["observation"], ["w"]), make("Tanh", ["w"], ["action"])],
            [floats("w", 1, 1)],
            "'w' has been used as output names multiple times",
        ),
        (
            [make("MatMul", ["observation", "w"], ["action"])],
            [floats("w", 5, 1)],
            "Incompatible dimensions for matrix multiplication",
        ),
        (
            [make("Tanh", ["observation"], ["action"], inner=body())],
            [],
            "Unrecognized attribute: inner for operator Tanh",
        ),
    ],
)
def test_a_network_that_contradicts_itself_is_refused_with_onnx_s_reason(
    nodes: list[Any], weights: list[Any], message: str
) -> None:
    refused = refusal(of_nodes(nodes, weights))
    assert refused.startswith("its network contradicts itself: ")
    assert f"; correct it in the program that made the file, and {SEAL_REMEDY}" in refused
    assert message in refused


def test_a_newer_format_than_onnx_reads_is_refused_with_the_one_to_set() -> None:
    model = onnx.load_from_string(of_nodes([make("Tanh", ["observation"], ["action"])], []))
    model.ir_version = 99
    assert refusal(seal(model)) == (
        f"its ir_version is 99; the installed onnx reads up to {onnx.IR_VERSION}: set "
        f"model.ir_version to {file.IR_VERSION}, and {SEAL_REMEDY}"
    )


def write_products(folder: Path, count: int, rows: int, width: int, tick: float = 0.05) -> Path:
    """Write a network of matrix products with the same weights."""
    names = ["wide", *(f"v{number}" for number in range(count - 1)), "narrow"]
    nodes = [
        make("Expand", ["observation", "s"], ["wide"]),
        *(make("MatMul", [a, "w"], [b]) for a, b in pairwise(names)),
        make("ReduceMean", ["narrow"], ["action"]),
    ]
    weights = [integers("s", rows, width), floats("w", width, width)]
    return write(folder, of_nodes(nodes, weights, card(tick=tick)))


def test_a_network_that_takes_over_half_a_tick_is_refused_with_its_time(tmp_path: Path) -> None:
    """80 products with the same weights: some 8 ms on a fast machine, for a tick of 2 ms."""
    path = write_products(tmp_path, 80, 1, 1100, tick=0.002)
    with pytest.raises(PolicyError) as caught:
        Network(file.read(path))
    expected = (
        r": this machine takes [\d.e+]+ ms to run it once, more than half of its tick of "
        r"2 ms; train a smaller network"
    )
    assert re.fullmatch(re.escape(str(path)) + expected, str(caught.value))


class CountingNetwork(Network):
    runs = 0

    def run(self) -> float:
        type(self).runs += 1
        return super().run()


def test_a_network_that_takes_seconds_is_refused_after_a_few_runs(tmp_path: Path) -> None:
    """Each of the 40 products has 10⁹ multiplications: a second for one run, not for eight."""
    path = write_products(tmp_path, 40, 1000, 1000)
    with pytest.raises(PolicyError, match=r"this machine takes [\d.e+]+ ms to run it once"):
        CountingNetwork(file.read(path))
    assert CountingNetwork.runs < 8


def test_a_usual_network_is_fast_enough_for_the_shortest_tick(tmp_path: Path) -> None:
    layers = random_layers(6, 64, 64, 1)
    names = ("fx", "fy", "fy_rate", "fin_velocity", "instruction_angle", "previous_angle")
    wide = card(*((name, 1.0) for name in names), tick=0.002)
    Network(file.read(write(tmp_path, to_onnx(layers, "tanh", wide))))


@pytest.mark.parametrize("opset", [file.OPSETS[0], 21])
def test_what_other_exporters_write_is_permitted(tmp_path: Path, opset: int) -> None:
    """Layers as MatMul and Add, constants in nodes, scaling in the network, squashed Gaussians."""
    half = numpy_helper.from_array(np.array(0.5, np.float32))
    nodes = [
        make("Constant", [], ["half"], value=half),
        make("Flatten", ["observation"], ["flat"]),
        make("Mul", ["flat", "half"], ["scaled"]),
        make("MatMul", ["scaled", "w0"], ["p"]),
        make("Add", ["p", "b0"], ["q"]),
        make("Elu", ["q"], ["r"]),
        make("Gemm", ["r", "w1", "b1"], ["mean"], transB=1),
        make("Tanh", ["mean"], ["squashed"]),
        make("Reshape", ["squashed", "s"], ["shaped"]),
        make("Clip", ["shaped", "low", "high"], ["action"]),
    ]
    weights = [floats("w0", 1, 8), floats("b0", 8), floats("w1", 1, 8), floats("b1", 1)]
    weights.append(integers("s", 1, 1))
    values = {"low": -1.0, "high": 1.0}
    weights += [numpy_helper.from_array(np.array(values[n], np.float32), n) for n in values]
    network = Network(file.read(write(tmp_path, of_nodes(nodes, weights, opset=opset))))
    assert network.run() == 0.0


def test_every_permitted_operator_is_one_of_onnx() -> None:
    latest = file.OPSETS[-1]
    for names in file.PERMITTED.values():
        assert [name for name in names if not onnx.defs.has(name, latest, "")] == []
