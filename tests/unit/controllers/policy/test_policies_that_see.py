"""Policy files whose network is given frames: what they answer, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from rigs.policy_files import (
    card,
    linear,
    of_pixels,
    refusal,
    seeing_card,
    velocity_follower,
    write,
)

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.controllers.policy import file, library
from fishd.controllers.policy.card import CARD_KEY, encode
from fishd.controllers.policy.file import SEAL_REMEDY, seal
from fishd.controllers.policy.network import Sight, to_onnx
from fishd.controllers.policy.runtime import Network
from fishd.core.camera_frames import StackSettings
from fishd.core.errors import ParameterError, PolicyError

FOLLOWER = velocity_follower()


def network(folder: Path, content: bytes) -> Network:
    return Network(file.read(write(folder, content)))


def test_a_network_is_given_frames_and_numbers(tmp_path: Path) -> None:
    about = seeing_card(("instruction_angle", 0.42), ("fy", 0.1))
    weights = np.zeros((2, 32, 32))
    weights[0, 3, 4], weights[1, 30, 31] = 0.001, -0.002
    policy = network(tmp_path, of_pixels(weights, about, 0.5, 0.25))
    assert policy.frames.shape == (2, 32, 32)
    assert policy.row.shape == (2,)
    policy.frames[:] = 7
    policy.frames[0, 3, 4], policy.frames[1, 30, 31] = 255, 100
    policy.row[:] = 0.4, -0.2
    assert policy.run() == pytest.approx(0.255 - 0.2 + 0.2 - 0.05)


def test_a_card_says_in_a_word_what_is_seen() -> None:
    assert card(("fy", 0.1)).sees == "forces"
    assert seeing_card().sees == "pictures"
    assert seeing_card(("instruction_angle", 0.42)).sees == "pictures"
    assert seeing_card(("fy", 0.1)).sees == "forces, pictures"


def test_a_file_of_which_frames_are_missing_or_others_is_refused() -> None:
    frames = "one uint8 input of shape [1, 2, 32, 32] named 'frames' is needed"
    wanted = f"{frames}: change them in the program that made the file, and {SEAL_REMEDY}"

    def refused(change: Any) -> str:
        model = onnx.load_model_from_string(FOLLOWER)
        change(model)
        return refusal(seal(model))

    def smaller(model: Any) -> None:
        model.graph.input[0].type.tensor_type.shape.dim[3].dim_value = 31

    def also_numbers(model: Any) -> None:
        about = encode(seeing_card(("fy", 0.1)))
        helper.set_model_props(model, {CARD_KEY: about})

    shape = "uint8 of shape [1, 2, 32, 31] named 'frames'"
    assert refused(smaller) == f"its inputs: {shape}; {wanted}"
    also = "and one float32 input of shape [1, 1] named 'observation' are"
    assert f"named 'frames' {also}" in refused(also_numbers)


def test_a_card_with_impossible_frames_is_refused_with_the_key_to_blame() -> None:
    model = onnx.load_model_from_string(FOLLOWER)
    text = encode(seeing_card()).replace('"size":32', '"size":4000')
    helper.set_model_props(model, {CARD_KEY: text})
    assert refusal(seal(model)).startswith("its card: pictures.size: 4000 is not valid")


def test_a_network_too_large_for_a_file_is_not_written() -> None:
    about = seeing_card(pictures=StackSettings(size=256, frames=8))
    width = 8 * 256 * 256
    nodes = [
        helper.make_node("Cast", [file.FRAMES], ["grey"], to=TensorProto.FLOAT),
        helper.make_node("Flatten", ["grey"], ["pixels"]),
    ]
    layers = [(np.ones((9, width)), np.zeros(9)), *linear(*np.ones(9))]
    with pytest.raises(
        PolicyError, match=r"policy take 18 MB, and 15 are the most; .* fewer units"
    ):
        to_onnx(layers, "tanh", about, Sight(nodes, {}, "pixels", width))


def test_the_loop_of_fishd_refuses_it_and_names_who_lets_it_swim(tmp_path: Path) -> None:
    path = write(tmp_path, FOLLOWER, "eye")
    with pytest.raises(ParameterError) as caught:
        registry.create("ppo", {"policy": str(path)}, Limits(0.42, 0.05))
    assert str(caught.value) == (
        f"ppo: policy: {path}: it needs pictures, which this loop does not have; run it with "
        f"'fishctl agent {path}', or in simulation with 'fishctl compare'"
    )


def test_a_description_says_what_it_sees(tmp_path: Path) -> None:
    description = library.describe(str(write(tmp_path, FOLLOWER, "eye")))
    assert (description.problem, description.inputs) == ("", "pictures")
    assert description.card["pictures"]["frames"] == 2
