"""Refusal of policy files with a damaged byte."""

import random

import onnx
import pytest
from onnx import helper
from rigs.policy_files import FLIP, card, random_layers, refusal

from fishd.controllers.policy import file, library
from fishd.controllers.policy.file import parse
from fishd.controllers.policy.network import to_onnx
from fishd.core.errors import PolicyError

DEFAULT = library.find("default-fish").read_bytes()


def test_a_flipped_bit_of_a_small_policy_is_refused_wherever_it_is() -> None:
    for place in range(0, len(FLIP), 3):
        bit = 1 << place % 8
        assert refusal(FLIP[:place] + bytes([FLIP[place] ^ bit]) + FLIP[place + 1 :])


def test_the_shipped_policy_is_refused_where_it_was_cut_off_or_something_was_added() -> None:
    draw = random.Random(1)
    for _ in range(50):
        assert refusal(DEFAULT[: draw.randrange(len(DEFAULT))])
    for extra in (b"\x00", b"\n", DEFAULT[-9:], DEFAULT):
        assert refusal(DEFAULT + extra)


def test_a_weight_that_is_another_number_is_called_damage() -> None:
    content = to_onnx(random_layers(1, 8, 1), "tanh", card())
    place = content.index(onnx.load_model_from_string(content).graph.initializer[0].raw_data)
    damaged = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    assert refusal(damaged) == (
        "it is damaged: its content does not match its checksum; copy it again; in a program that "
        "changes it, call fishd.controllers.policy.file.seal as the last step"
    )


def test_a_file_without_a_checksum_or_with_two_is_refused() -> None:
    model = onnx.load_model_from_string(FLIP)
    entries = {entry.key: entry.value for entry in model.metadata_props}
    digest = entries.pop(file.CHECKSUM_KEY)
    helper.set_model_props(model, entries)
    assert refusal(model.SerializeToString()).startswith("its metadata lacks fishd.sha256, ")
    for value in ("0" * 64, digest, "", "none"):
        model.metadata_props.add(key=file.CHECKSUM_KEY, value=value)
        assert refusal(model.SerializeToString()).startswith("it is damaged: ")


def test_a_model_that_is_sealed_again_is_whole() -> None:
    model = onnx.load_model_from_string(FLIP)
    assert file.seal(model) == FLIP
    model.doc_string = "by another tool"
    assert file.parse(file.seal(model)) == card()


@pytest.mark.parametrize("content", [b"\x0a\x05abc", b"\x0b", b"\xff" * 11, b"\x09abc"])
def test_what_breaks_off_is_no_model(content: bytes) -> None:
    with pytest.raises(PolicyError, match="this is not an ONNX model"):
        parse(content)
