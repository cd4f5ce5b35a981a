"""Conversion of foreign text, such as an exception's, for logs, replies and terminals."""

from fishd.core.errors import Escaped, FishdError

MAX_LINE_CHARACTERS = 1000
"""Maximum length of a text; longer ones are cut in the middle [characters]."""
MAX_WORD_CHARACTERS = 60
"""Maximum length of a word that is quoted in a message [characters]."""
FORMULA_CHARACTERS = tuple("=+-@＝＋－＠")
"""First characters of a text that a spreadsheet would evaluate as a formula."""
EXACT_CI95 = 1e-9
"""Half-width of a 95 % confidence interval below which a value counts as exact [N, or its unit]."""


def line(text: str, longest: int = MAX_LINE_CHARACTERS) -> str:
    """Return one printable line: line breaks become spaces, unprintable characters `?`."""
    text = block(text, longest)
    if "\n" not in text:
        return text.strip()
    return " ".join(part.strip() for part in text.splitlines() if part.strip())


def block(text: str, longest: int = MAX_LINE_CHARACTERS) -> str:
    """Return printable text that keeps its line breaks and indentation."""
    if len(text) > longest:  # cut the middle
        end = longest // 3
        text = f"{text[: longest - end - 1]}…{text[-end:]}"
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() or letter == "\n" else " " if letter.isspace() else "?"
        for letter in text
    )


def escaped(text: str) -> str:
    """Return the text with unprintable characters as escapes, such as `\\x1b` or `\\n`."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def for_spreadsheet(text: str) -> str:
    """Escape control characters, and put a `'` before a text that a spreadsheet would evaluate."""
    return ("'" if text.startswith(FORMULA_CHARACTERS) else "") + escaped(text)


def quoted(word: str) -> str:
    """Return a foreign word, cut to fit in a message."""
    return line(word, MAX_WORD_CHARACTERS)


def format_half_width(ci95: float) -> str:
    """Return the half-width of a 95 % confidence interval in thousandths: `± 0.12`, or `exact`."""
    if ci95 < EXACT_CI95:
        return "exact"
    return f"± {1e3 * ci95:.2f}" if ci95 >= 5e-6 else f"± {1e3 * ci95:.1g}"


def format_measured(value: float, ci95: float | None, unit: str = "") -> str:
    """Return a value in thousandths with its interval: `25.74 ± 0.12 mN` or `25.74 mN (exact)`.

    ci95: half-width of the 95 % confidence interval; None if unknown
    unit: unit such as N, printed with the prefix `m`
    """
    unit = f" m{quoted(unit)}" if unit else ""
    if ci95 is None:
        return f"{1e3 * value:.2f}{unit}"
    interval = format_half_width(ci95)
    if interval == "exact":
        return f"{1e3 * value:.2f}{unit} (exact)"
    return f"{1e3 * value:.2f} {interval}{unit}"


def error_message(error: BaseException) -> str:
    """Return the text of an exception in one line, which may be empty. Never raises."""
    try:
        return line(str(error))
    except BaseException as str_error:  # __str__ may be foreign code, too
        return f"(no text: its __str__ raised {quoted(type(str_error).__name__)})"


def describe_error(error: BaseException) -> str:
    """Return an exception in one line: the message of one of fishd's, else type and message."""
    message = error_message(error)
    if isinstance(error, FishdError | Escaped):
        return message
    kind = quoted(type(error).__name__)
    return f"{kind}: {message}" if message else kind
