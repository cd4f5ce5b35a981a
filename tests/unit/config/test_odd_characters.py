"""Characters in a YAML file that cannot be seen, or that look like a space, are named with their
line; and I2C addresses whose 0x was forgotten.
"""

from pathlib import Path

import pytest
from rigs.recordings import record_run, swum

from fishd.config import load
from fishd.core.errors import ConfigError
from fishd.core.strict_yaml import YamlProblem, dump, parse
from fishd.recording import open_run, writer

SPACE = "is not a space for YAML: type a space, or put the text in quotes"


@pytest.mark.parametrize(
    ("text", "line", "name"),
    [
        ("tick: 0.05\nrobot: \0pi\n", 2, "NUL (U+0000) is not permitted"),
        ("tick: 0.05\nrobot: pi\n\x1a", 3, "Ctrl-Z (U+001A) is not permitted"),
        ("tick: 0.05\nrobot: \x1b[1mpi\n", 2, "ESC (U+001B) is not permitted"),
        ("tick: 0.05\r\n# \x07\r\n", 2, "a control character (U+0007) is not permitted"),
        ("tick: 0.05\nservo:\n\xa0 gpio: 18\n", 3, f"a no-break space (U+00A0) {SPACE}"),
        ("tick: 0.05\nrobot:\xa0pi\n", 2, f"a no-break space (U+00A0) {SPACE}"),
        ("robot: pi\xa0\n", 1, f"a no-break space (U+00A0) {SPACE}"),
        ("tick: 0.05\n\u2003robot: pi\n", 2, f"an em space (U+2003) {SPACE}"),
        ("tick: 0.05\n\ufeffrobot: pi\n", 2, f"a zero width no-break space (U+FEFF) {SPACE}"),
        ("tick:\u200b0.05\n", 1, f"a zero width space (U+200B) {SPACE}"),
        ("robot: pi\u2060\n", 1, f"a word joiner (U+2060) {SPACE}"),
        ("robot: \u202epi\n", 1, f"a right-to-left override (U+202E) {SPACE}"),
        ("tick: 0.05 # a\u2028robot: pi\n", 1, f"a line separator (U+2028) {SPACE}"),
        ("servo:\n\tgpio: 18\n", 2, "a tab is not permitted here: type spaces instead"),
        ("tick:\t0.05\n", 1, "a tab is not permitted here: type spaces instead"),
    ],
)
def test_what_cannot_be_seen_is_named_with_its_line(
    text: str, line: int, name: str, tmp_path: Path
) -> None:
    file = tmp_path / "fish.yaml"
    file.write_bytes(text.encode())
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert str(caught.value).startswith(f"{file}:{line}: {name}")


def test_a_text_in_quotes_a_comment_and_a_byte_order_mark_may_have_such_characters() -> None:
    text = "\ufeffa: '12\xa0kg' # 1\xa0kg\nb: |\n  3\u2009N\n"
    assert parse(text).data == {"a": "12\xa0kg", "b": "3\u2009N\n"}


@pytest.mark.parametrize(
    "word",
    [
        "\U0001f469\u200d\U0001f52c lab",
        "\u0645\u06cc\u200c\u0631\u0648\u062f",
        "Tail\xadfin",
        "a\u200eb",
    ],
)
def test_joiners_and_soft_hyphens_are_parts_of_words(word: str) -> None:
    assert parse(f"name: {word}\n{word}: 1\n").data == {"name": word, word: 1}


def test_a_recording_whose_fishd_wrote_odd_spaces_without_quotes_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "to_yaml", lambda config: "name: x\xa0y\n")  # as formerly
    path = record_run(swum(), tmp_path / "run")
    assert open_run(path).settings_of(0) == {"name": "x\xa0y"}


@pytest.mark.parametrize("text", ["x\xa0y", "\u2003", "a\u2028b", "\ufeffx", "é"])
def test_what_is_written_can_be_read_again(text: str) -> None:
    assert parse(dump({"a": [text]})).data == {"a": [text]}


def test_an_error_behind_a_harmless_one_keeps_its_own_reason() -> None:
    with pytest.raises(YamlProblem, match="not valid YAML") as caught:
        parse("a: 1 # 1\xa0kg\nb: [1\n")
    assert caught.value.line > 1


@pytest.mark.parametrize(
    ("key", "value", "hint"),
    [
        ("force_sensor", "48", "; 0x48 may be meant"),
        ("force_sensor", "'0x4b'", "; 0x4b may be meant"),
        ("virtual_pi", "49", "; 0x49 may be meant"),
        ("sensors.power", "40", "; 0x40 may be meant"),
        ("force_sensor", "90", " is needed"),
    ],
)
def test_an_i2c_address_without_0x_is_recognised(
    key: str, value: str, hint: str, tmp_path: Path
) -> None:
    file = tmp_path / "fish.yaml"
    section = f"{{kind: ina219, address: {value}}}" if "." in key else f"{{address: {value}}}"
    section = section if "." not in key else f"{{power: {section}}}"
    file.write_text(f"robot: virtual-pi\n{key.partition('.')[0]}: {section}\n")
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert f"{key}.address: " in str(caught.value)
    assert str(caught.value).endswith(hint)
