"""Makes text from outside, such as an exception's, safe for logs, replies and terminals."""

from fishd.core.errors import Escaped, FishdError

LONGEST = 1000
"""Longer texts are cut, in the middle [characters]."""
LONGEST_WORD = 60
"""Of a word that is quoted in a message [characters]."""
FORMULAS = tuple("=+-@＝＋－＠")
"""Characters at the beginning of a text that a spreadsheet computes."""
EXACT_CI95 = 1e-9
"""Half-width of a 95 % interval below which a value is called exact [N, or another unit]."""


def line(text: str, longest: int = LONGEST) -> str:
    """One printable line that can be encoded: line breaks become spaces, odd characters `?`."""
    text = block(text, longest)
    if "\n" not in text:
        return text.strip()
    return " ".join(part.strip() for part in text.splitlines() if part.strip())


def block(text: str, longest: int = LONGEST) -> str:
    """The same, but with its line breaks and indentation."""
    if len(text) > longest:  # what is in the middle is left out
        end = longest // 3
        text = f"{text[: longest - end - 1]}…{text[-end:]}"
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() or letter == "\n" else " " if letter.isspace() else "?"
        for letter in text
    )


def escaped(text: str) -> str:
    """Return the text with what cannot be printed as escapes, such as `\\x1b` or `\\n`."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def for_spreadsheet(text: str) -> str:
    """Escape control characters, and put a `'` before what a spreadsheet would compute."""
    return ("'" if text.startswith(FORMULAS) else "") + escaped(text)


def quoted(word: str) -> str:
    """A word from outside, cut to fit in a message."""
    return line(word, LONGEST_WORD)


def format_half_width(ci95: float) -> str:
    """Return the half-width of a 95 % interval in thousandths: `± 0.12`, or `exact`."""
    if ci95 < EXACT_CI95:
        return "exact"
    return f"± {1e3 * ci95:.2f}" if ci95 >= 5e-6 else f"± {1e3 * ci95:.1g}"


def format_measured(value: float, ci95: float | None, unit: str = "") -> str:
    """Return a value in thousandths, with its interval: `25.74 ± 0.12 mN` or `25.74 mN (exact)`.

    ci95: half-width of the 95 % interval; None where it is not known
    unit: such as N; `m` goes before it
    """
    unit = f" m{quoted(unit)}" if unit else ""
    if ci95 is None:
        return f"{1e3 * value:.2f}{unit}"
    interval = format_half_width(ci95)
    if interval == "exact":
        return f"{1e3 * value:.2f}{unit} (exact)"
    return f"{1e3 * value:.2f} {interval}{unit}"


def said(error: BaseException) -> str:
    """The text of an exception in one line, which may be empty. Never raises."""
    try:
        return line(str(error))
    except BaseException as worse:  # whoever wrote the exception wrote its __str__, too
        return f"(its text cannot be had: {quoted(type(worse).__name__)})"


def named(error: BaseException) -> str:
    """An exception in one line: one of fishd's is a sentence by itself, others say their type."""
    what = said(error)
    if isinstance(error, FishdError | Escaped):
        return what
    kind = quoted(type(error).__name__)
    return f"{kind}: {what}" if what else kind
