"""Text from outside: whatever it is, it ends as one short line that can be printed and encoded."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.core import text
from fishd.core.errors import Escaped, Refused

anything = st.text(st.characters(codec=None, exclude_categories=()), max_size=3000)


@given(anything)
def test_a_line_is_printable_encodable_and_short(odd: str) -> None:
    line = text.line(odd)
    assert line.isprintable()
    assert len(line.encode()) <= 4 * text.MAX_LINE_CHARACTERS
    assert len(line) <= text.MAX_LINE_CHARACTERS


@given(anything)
def test_a_block_keeps_its_line_breaks_and_nothing_else_that_is_odd(odd: str) -> None:
    block = text.block(odd, 10_000)
    assert len(block) == len(odd)
    assert all(line.isprintable() for line in block.split("\n"))


@pytest.mark.parametrize(
    ("odd", "plain"),
    [
        ("as  it is – µs", "as  it is – µs"),
        ("two\r\n   lines\n", "two lines"),
        ("\x1b[2Jgone", "?[2Jgone"),
        ("half: \udcff", "half: ?"),
        ("\u202etxet", "?txet"),
    ],
)
def test_what_is_odd_becomes_a_question_mark_and_the_rest_stays(odd: str, plain: str) -> None:
    assert text.line(odd) == plain


def test_a_long_text_keeps_its_beginning_and_its_end() -> None:
    line = text.line("begin" + "x" * 5_000_000 + "end")
    assert len(line) == text.MAX_LINE_CHARACTERS
    assert line.startswith("begin")
    assert line.endswith("end")
    assert "…" in line


class Mute(Exception):
    def __str__(self) -> str:
        raise SystemExit(0)


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("no\nnumber"), "ValueError: no number"),
        (KeyboardInterrupt(), "KeyboardInterrupt"),
        (Refused("busy", "try again"), "try again"),
        (Escaped("SystemExit: 3"), "SystemExit: 3"),
        (Mute(), "Mute: (no text: its __str__ raised SystemExit)"),
        (RuntimeError("\udcff"), "RuntimeError: ?"),
    ],
)
def test_an_exception_is_named_whatever_it_is(error: BaseException, line: str) -> None:
    assert text.describe_error(error) == line


@pytest.mark.parametrize(
    ("ci95", "said"),
    [(0.12e-3, "25.74 ± 0.12 mN"), (1.7e-18, "25.74 mN (exact)"), (None, "25.74 mN")],
)
def test_an_interval_of_zero_is_called_exact_and_not_zero(ci95: float | None, said: str) -> None:
    assert text.format_measured(25.74e-3, ci95, "N") == said
