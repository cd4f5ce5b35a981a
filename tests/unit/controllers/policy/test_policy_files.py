"""Refusal of files that are not policy files, or are dangerous, with the reason in one line."""

import io
import os
import pickle
import re
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from rigs.documents import FENCE, ROOT, text_of
from rigs.policy_files import FLIP, card, random_layers, refusal, write

from fishd.controllers.policy import file
from fishd.controllers.policy.card import CARD_KEY, encode
from fishd.controllers.policy.file import SEAL_REMEDY, seal
from fishd.controllers.policy.network import to_onnx
from fishd.controllers.policy.runtime import Network
from fishd.core.errors import PolicyError

Change = Callable[[Any], None]


def changed(change: Change, content: bytes = FLIP) -> bytes:
    """A policy file after a change of its ONNX model, with a checksum that fits."""
    model = onnx.load_model_from_string(content)
    change(model)
    return seal(model)


def with_card(**values: Any) -> bytes:
    """A policy file in whose card these keys have these values, or are missing where None."""
    data = msgspec.json.decode(encode(card())) | values
    text = msgspec.json.encode({key: value for key, value in data.items() if value is not None})
    return changed(lambda model: helper.set_model_props(model, {CARD_KEY: text.decode()}))


class Trap:
    """Leaves a trace when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.trace),)


@pytest.mark.parametrize("protocol", [0, 2, pickle.HIGHEST_PROTOCOL])
def test_a_pickle_is_refused_and_never_unpickled(tmp_path: Path, protocol: int) -> None:
    path = write(tmp_path, pickle.dumps(Trap(tmp_path / "trace"), protocol))
    expected = "is a pickle, which could run any code" if protocol >= 2 else "not an ONNX model"
    with pytest.raises(PolicyError, match=expected):
        file.read(path)
    assert not (tmp_path / "trace").exists()
    pickle.loads(path.read_bytes())
    assert (tmp_path / "trace").exists()  # the file would have run code


def test_an_archive_of_torch_or_baselines_is_refused_and_never_unpickled(tmp_path: Path) -> None:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as made:
        made.writestr("policy/data.pkl", pickle.dumps(Trap(tmp_path / "trace")))
    pickled = "this is a zip archive as torch writes, with a pickle, which could run any code; "
    assert refusal(archive.getvalue()) == pickled + file.WRITERS
    assert not (tmp_path / "trace").exists()
    with zipfile.ZipFile(archive, "a") as made:
        made.writestr("_stable_baselines3_version", "2.9.2")
    message = refusal(archive.getvalue())
    assert message.startswith("this is a model of stable-baselines3, with pickles, which could ")
    assert message.endswith("write it with fishd.learning.export.export_model")


def test_the_writers_that_a_refusal_names_exist() -> None:
    named = re.findall(r"fishd\.[\w.]+", f"{file.WRITERS} {file.EXPORT_MODEL} {SEAL_REMEDY}")
    assert len(named) == 4
    for name in named:
        module, _, function = name.rpartition(".")
        assert find_spec(module), name
        source = Path(ROOT, *module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
        assert f"\ndef {function}(" in source


@pytest.mark.parametrize("content", [b"", b"\x00", b"hello fish", b"\x08\x07" * 9, os.urandom(999)])
def test_what_is_no_onnx_is_refused(content: bytes) -> None:
    assert refusal(b"\x01" + content) == f"this is not an ONNX model; {file.WRITERS}"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"format": 4}, "its card has format 4; this fishd reads format 3"),
        (
            {"format": 2},
            "its card has format 2; this fishd reads format 3: it was written by an older fishd; "
            "train and export it again",
        ),
        ({"tick": None}, "its card: tick: is missing: a number in [1e-30, 1e+30] is needed"),
        ({"amplitude": -0.42}, "its card: amplitude: -0.42 is not valid"),
        ({"observation": []}, "its card names neither an observation nor pictures"),
        (
            {"observation": [{"name": "fz", "scale": 1.0}]},
            "its card: observation.name: 'fz' is not",
        ),
        ({"observation": [{"name": "fy", "scale": 1e-320}]}, "its card: observation.scale: 1e-320"),
        ({"provenance": None}, "its card: provenance: is missing"),
    ],
)
def test_a_bad_card_is_refused_with_the_key_to_blame(values: dict[str, Any], message: str) -> None:
    assert refusal(with_card(**values)).startswith(message)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("NaN", "is not JSON: "),
        ("[1]", "is not a JSON object"),
        ("[" * 50_000, "is JSON that is nested too deeply"),
        ('{"provenance":' * 100 + "1" + "}" * 100, "is JSON that is nested too deeply"),
        (" " * 100_000, "has 100000 characters; at most 65536 are permitted"),
    ],
)
def test_a_card_that_is_not_json_or_no_object_is_refused(text: str, why: str) -> None:
    content = changed(lambda model: helper.set_model_props(model, {CARD_KEY: text}))
    assert refusal(content).startswith(f"its card {why}")


def rename_input(model: Any) -> None:
    model.graph.input[0].name = "obs"


def open_batch(model: Any) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_param = "batch"


def second_input(model: Any) -> None:
    model.graph.input.append(helper.make_tensor_value_info("camera", TensorProto.FLOAT, [84, 84]))


def no_output(model: Any) -> None:
    del model.graph.output[:]


_IN = "one float32 input of shape [1, 1] named 'observation' is needed"
RENAMED = "needed: change them in the program that made the file"
_OUT = "one float32 output of shape [1, 1] named 'action' is needed"


@pytest.mark.parametrize(
    ("change", "actual", "wanted"),
    [
        (rename_input, "its inputs: float32 of shape [1, 1] named 'obs'", _IN),
        (open_batch, "its inputs: float32 of shape [batch, 1] named 'observation'", _IN),
        (second_input, ", float32 of shape [84, 84] named 'camera'", _IN),
        (no_output, "its outputs: none", _OUT),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_wrong_ends_are_refused_with_right_ones(change: Change, actual: str, wanted: str) -> None:
    message = refusal(changed(change))
    assert actual in message
    assert wanted in message
    assert message.endswith(f"{RENAMED}, and {SEAL_REMEDY}")


@pytest.mark.parametrize(("bad", "layer"), [(np.nan, 0), (-np.inf, 2)])
def test_weights_that_are_not_finite_are_refused_behind_a_tanh(bad: float, layer: int) -> None:
    content = to_onnx(random_layers(1, 8, 8, 1), "tanh", card())

    def spoil(model: Any) -> None:
        tensor = next(t for t in model.graph.initializer if t.name == f"weight_{layer}")
        array = numpy_helper.to_array(tensor).copy()
        array.flat[-1] = bad
        tensor.CopyFrom(numpy_helper.from_array(array, tensor.name))

    assert refusal(changed(spoil, content)) == (
        f"its weights 'weight_{layer}' are not all finite numbers: the training diverged; "
        "export an earlier checkpoint"
    )


def double(model: Any) -> None:
    model.metadata_props.add(key=CARD_KEY, value=encode(card(amplitude=0.1)))


def move_out(model: Any) -> None:
    tensor = model.graph.initializer[0]
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")


def shorten(model: Any) -> None:
    model.graph.initializer[0].dims[0] = 7


def constant_node(model: Any) -> None:
    nan = numpy_helper.from_array(np.array([np.nan], np.float32))
    model.graph.node.insert(0, helper.make_node("Constant", [], ["hidden"], value=nan))


def constant_number(model: Any) -> None:
    model.graph.node.insert(0, helper.make_node("Constant", [], ["hidden"], value_float=np.inf))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (double, "its metadata has 2 entries fishd.card, which may contradict one another"),
        (move_out, "its weights 'weight_0' are in another file; save the model as a single file"),
        (shorten, "its weights 'weight_0' cannot be read: "),
        (constant_node, "not all finite"),
        (constant_number, "not all finite"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_the_model_lacks_or_hides_is_refused(change: Change, words: str) -> None:
    assert words in refusal(changed(change))


def of_another_tool(*inputs: Any, outputs: int = 1) -> Any:
    """A model without a card: the first input, through a tanh."""
    ends = [
        helper.make_tensor_value_info(f"out{n}", TensorProto.FLOAT, [1]) for n in range(outputs)
    ]
    nodes = [helper.make_node("Tanh", ["obs"], [f"out{n}"]) for n in range(outputs)]
    graph = helper.make_graph(nodes, "net", list(inputs), ends)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])


def test_a_file_of_another_tool_is_refused_with_its_ends_and_the_way_to_a_policy_file() -> None:
    observation = helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["batch", 5])
    message = refusal(of_another_tool(observation).SerializeToString())
    assert (
        "its metadata lacks fishd.card. Its inputs: float32 of shape [batch, 5] named 'ob"
        in message
    )
    assert "its outputs: float32 of shape [1] named 'out0'. Write a model of stable-ba" in message
    assert message.endswith(f"add the card, and {SEAL_REMEDY}")


def test_of_many_outputs_a_refusal_names_the_first() -> None:
    observation = helper.make_tensor_value_info("obs", TensorProto.DOUBLE, [1])
    message = refusal(of_another_tool(observation, outputs=99).SerializeToString())
    assert "Its inputs: double of shape [1] named 'obs'; its outputs: " in message
    assert "named 'out3', 95 more. Write" in message


def test_a_file_of_another_tool_becomes_a_policy_with_names_card_and_seal(tmp_path: Path) -> None:
    model = of_another_tool(helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, 1]))
    helper.set_model_props(model, {CARD_KEY: encode(card())})
    unsealed = refusal(model.SerializeToString())
    assert unsealed.startswith("its metadata lacks fishd.sha256, the checksum; in the program")
    assert unsealed.endswith(SEAL_REMEDY)
    assert refusal(seal(model)).startswith("its inputs: float32 of shape [1, 1] named 'obs'; one ")
    model.graph.input[0].name = model.graph.node[0].input[0] = "observation"
    assert refusal(seal(model)).startswith("its outputs: float32 of shape [1] named 'out0'; one ")
    model.graph.output[0].CopyFrom(
        helper.make_tensor_value_info("action", TensorProto.FLOAT, [1, 1])
    )
    model.graph.node[0].output[0] = "action"
    assert file.read(write(tmp_path, seal(model))).card == card()


def test_the_page_shows_how_a_file_of_another_tool_becomes_a_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width])]
        for name, width in (("observation", 2), ("action", 1))
    ]
    weights = numpy_helper.from_array(np.float32([[0.5], [-0.25]]), "weights")
    nodes = [helper.make_node("MatMul", ["observation", "weights"], ["action"])]
    model = helper.make_model(
        helper.make_graph(nodes, "main_graph", *ends, [weights]),
        producer_name="pytorch",
        opset_imports=[helper.make_opsetid("", 20)],
    )
    monkeypatch.chdir(tmp_path)
    onnx.save(model, "other.onnx")
    page = ROOT / "docs/reference/policies.md"
    (example,) = (code for _, code in FENCE.findall(text_of(page)) if "other.onnx" in code)
    exec(compile(example, page, "exec"), {})
    network = Network(file.read(tmp_path / "mine.onnx"))
    network.row[:] = 0.4, 0.2
    assert network.run() == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("name", "message"),
    [("missing.onnx", "no such file"), (".", "is a folder; a regular file is needed")],
)
def test_a_path_that_leads_to_no_file_is_named(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(PolicyError) as caught:
        file.read(tmp_path / name)
    assert str(caught.value) == f"{tmp_path / name}: {message}"


def test_a_service_says_where_a_file_it_cannot_see_belongs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/fishd")
    with pytest.raises(PolicyError) as caught:
        file.read(Path("/home/nobody-here/swim.onnx"))
    assert str(caught.value) == (
        "/home/nobody-here/swim.onnx: no such file: this fishd is a service without access to home "
        "folders; put the file into /var/lib/fishd/policies and give its name"
    )


def test_a_file_that_is_far_too_large_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, b"")
    os.truncate(path, 2**40)  # a hole: reading it would take the memory of the machine
    with pytest.raises(PolicyError, match="is longer than 16 MB, far more than a policy needs"):
        file.read(path)
