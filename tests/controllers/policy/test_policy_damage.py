"""A damaged policy file is refused, whichever of its bytes is another one."""

import random

import onnx
from onnx import helper
from rigs.policy_files import FLIP, card, random_layers, refusal

from fishd.controllers.policy import checksum, file, library
from fishd.controllers.policy.network import to_onnx

DEFAULT = library.find("default-fish").read_bytes()


def test_every_flipped_bit_of_a_small_policy_is_refused() -> None:
    for place in range(len(FLIP)):
        bit = 1 << place % 8
        assert refusal(FLIP[:place] + bytes([FLIP[place] ^ bit]) + FLIP[place + 1 :])


def test_the_shipped_policy_is_refused_with_any_of_its_bytes_changed() -> None:
    draw = random.Random(0)
    for _ in range(400):
        place, flip = draw.randrange(len(DEFAULT)), draw.randrange(1, 256)
        assert refusal(DEFAULT[:place] + bytes([DEFAULT[place] ^ flip]) + DEFAULT[place + 1 :])


def test_the_shipped_policy_is_refused_where_it_was_cut_off_or_something_was_added() -> None:
    draw = random.Random(1)
    for _ in range(200):
        assert refusal(DEFAULT[: draw.randrange(len(DEFAULT))])
    for extra in (b"\x00", b"\n", DEFAULT[-9:], DEFAULT):
        assert refusal(DEFAULT + extra)


def test_the_shipped_policy_is_refused_with_a_block_of_zeros_or_two_blocks_swapped() -> None:
    size = 4096
    for start in range(0, len(DEFAULT) - size, size):
        blank = DEFAULT[:start] + bytes(size) + DEFAULT[start + size :]
        first, second = DEFAULT[:size], DEFAULT[start : start + size]
        for content in (blank, second + DEFAULT[size:start] + first + DEFAULT[start + size :]):
            if content != DEFAULT and start:
                assert refusal(content)


def test_a_weight_that_is_another_number_is_called_damage() -> None:
    content = to_onnx(random_layers(1, 8, 1), "tanh", card())
    place = content.index(onnx.load_model_from_string(content).graph.initializer[0].raw_data)
    damaged = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    assert refusal(damaged) == (
        "it is damaged: its content does not fit its checksum; copy it here again, or export it "
        "again with 'fishctl learn export'"
    )


def test_a_file_without_a_checksum_or_with_two_is_refused() -> None:
    model = onnx.load_model_from_string(FLIP)
    entries = {entry.key: entry.value for entry in model.metadata_props}
    digest = entries.pop(checksum.KEY)
    helper.set_model_props(model, entries)
    assert refusal(model.SerializeToString()).startswith("its metadata lacks fishd.sha256, ")
    for value in ("0" * 64, digest, "", "none"):
        model.metadata_props.add(key=checksum.KEY, value=value)
        assert refusal(model.SerializeToString()).startswith("it is damaged: ")


def test_a_model_that_is_sealed_again_is_whole() -> None:
    model = onnx.load_model_from_string(FLIP)
    assert checksum.sealed(model) == FLIP
    model.doc_string = "by another tool"
    assert file.parse(checksum.sealed(model)) == card()
