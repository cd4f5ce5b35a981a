"""The ONNX file that is written: what numpy says, and what onnxruntime makes of it."""

from typing import Literal

import numpy as np
import onnx
import pytest
from rigs.policy_files import answer, card, linear, random_layers

from fishd.controllers.policy import file
from fishd.controllers.policy.network import to_onnx
from fishd.controllers.policy.runtime import load
from fishd.core.errors import PolicyError

FEATURES = (("fy", 0.02), ("fy_rate", 0.3), ("instruction_angle", 0.42), ("fin_velocity", 0.002))


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("hidden", [(), (64, 64)])
def test_onnx_equals_numpy(activation: Literal["tanh", "relu"], hidden: tuple[int, ...]) -> None:
    layers = random_layers(4, *hidden, 1)
    session = load().InferenceSession(to_onnx(layers, activation, card(*FEATURES)))
    for inputs in np.random.default_rng(1).normal(0.0, 1.5, (200, 4)).astype(np.float32):
        (output,) = session.run(["action"], {"observation": inputs[np.newaxis]})
        assert output.item() == pytest.approx(answer(layers, activation, inputs), abs=1e-6)


def test_the_card_comes_back_as_it_was() -> None:
    written = card(*FEATURES, tick=0.02, amplitude=0.8)
    assert file.parse(to_onnx(random_layers(4, 8, 1), "relu", written)) == written


def test_an_old_onnxruntime_can_read_it_and_the_same_policy_is_the_same_bytes() -> None:
    content = to_onnx(random_layers(4, 64, 64, 1), "tanh", card(*FEATURES))
    model = onnx.load_model_from_string(content)
    assert model.ir_version <= 10  # of onnxruntime 1.20
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 13)]
    assert content == to_onnx(random_layers(4, 64, 64, 1), "tanh", card(*FEATURES))
    assert len(content) < 32 * 1024


def test_layers_that_do_not_fit_one_another_or_the_card_are_refused() -> None:
    with pytest.raises(PolicyError, match=r"layer 0: weights \(1, 2\) .* do not fit 1 inputs"):
        to_onnx(linear(1.0, 2.0), "tanh", card())
    with pytest.raises(PolicyError, match=r"layer 1: weights \(1, 8\) .* do not fit 4 inputs"):
        to_onnx([*random_layers(1, 4), *random_layers(8, 1)], "tanh", card())
    with pytest.raises(PolicyError, match="at least one layer"):
        to_onnx([], "tanh", card())


def test_what_would_be_refused_when_it_is_read_is_not_written() -> None:
    with pytest.raises(PolicyError, match="weights 'weight_0' are not all finite"):
        to_onnx(linear(float("nan")), "tanh", card())
    with pytest.raises(PolicyError, match="its outputs: float32 of shape"):
        to_onnx(random_layers(1, 2), "tanh", card())
