"""Command line of measurements, tables in Markdown, and their places in docs/."""

import argparse
import ast
import importlib
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

DOCS = Path(__file__).resolve().parents[2] / "docs"
Options = dict[str, dict[str, Any]]
"""Options of a command line: arguments of `ArgumentParser.add_argument`, by name."""
JOBS: Options = {"--jobs": {"type": int, "default": os.cpu_count(), "help": "number of processes"}}
"""Option of a measurement that runs its cases in parallel."""


class Report(NamedTuple):
    """Result of a measurement or of one of its parts."""

    sections: dict[str, str]
    """Markdown by the name of the markers in the document that enclose it."""
    figures: Any
    """Results for programs, as data that msgspec can write as JSON."""
    broken: bool = False
    """Whether a promise of fishd was not kept; the exit status is 1 then."""
    number: str = ""
    """The result in one line, for a cell of a table in docs/; it is written instead of the only
    section, which is for people."""


class BrokenPromise(BaseException):
    """A promise of fishd was not kept; fishd must not catch this exception."""


def run(package: str, names: Sequence[str]) -> int:
    """Run the measurement of the command line, and return the exit status.

    package: folder below tools/; each of `names` is a module in it with `OPTIONS` and
    `measure(options) -> Report`
    """
    parser = argparse.ArgumentParser(prog=f"tools/{package}")
    commands = parser.add_subparsers(dest="name", metavar="NAME", required=True)
    for name in names:
        text = _docstring(f"{package}.{name}")
        command = commands.add_parser(
            name,
            help=text.partition("\n")[0].replace("%", "%%"),
            description=text,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name in sys.argv[1:2]:  # other modules may need extras that are not installed
            module = importlib.import_module(f"{package}.{name}")
            for option, settings in module.OPTIONS.items():
                command.add_argument(option, **settings)
            command.add_argument("--json", action="store_true", help="print all figures as JSON")
            command.add_argument("--write", action="store_true", help="put the result into docs/")
    options = parser.parse_args()
    try:
        report = module.measure(options)
    except BrokenPromise as broken:
        print(f"{package} {options.name}: BROKEN: {broken}", file=sys.stderr)
        return 1
    text = "\n\n".join(report.sections.values())
    print(msgspec.json.encode(report.figures).decode() if options.json else text)
    if options.write:
        for marker, section in report.sections.items():
            if page := _page_with(marker):
                put(page, marker, report.number or section, in_line=bool(report.number))
    return int(report.broken)


def run_cases(function: Callable[[Any], Any], cases: Iterable[Any], jobs: int | None) -> list[Any]:
    """Return the result of a function for each case, computed in several processes."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(function, cases))


def _docstring(module: str) -> str:
    spec = find_spec(module)
    assert spec
    assert spec.origin
    source = Path(spec.origin).read_text(encoding="utf-8")
    return ast.get_docstring(ast.parse(source)) or ""


def progress(*words: str) -> None:
    """Write the progress of a long measurement to standard error."""
    print(" | ".join(words), file=sys.stderr, flush=True)


def table(head: str, rows: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown; the cells of its head are separated by " | "."""
    rule = "|" + "---|" * len(head.split(" | "))
    return "\n".join((f"| {head} |", rule, *(f"| {' | '.join(row)} |" for row in rows)))


def put(document: Path, name: str, text: str, *, in_line: bool = False) -> None:
    """Replace the text between the two markers of `name` in a document.

    in_line: whether the markers are in a line, such as a row of a table
    Raises SystemExit where the markers are missing.
    """
    before, _, after = _parted(document, name)
    gap = " " if in_line else "\n\n"
    document.write_text(f"{before}{gap}{text}{gap}{after}", encoding="utf-8")


def between(document: Path, name: str) -> str:
    """Return the text between the two markers; raises as `put` does."""
    return _parted(document, name)[1].strip("\n")


def write_reference(tool: str, sections: Iterable[tuple[str, str, str]]) -> int:
    """Print generated sections, write them into docs/, or check them; return the exit status.

    sections: for each the document, the name of its markers, and the text between them
    """
    command = f"python tools/{tool}.py --write"
    parser = argparse.ArgumentParser(prog=f"tools/{tool}.py")
    parser.add_argument("--write", action="store_true", help="put the result into docs/")
    parser.add_argument("--check", action="store_true", help="exit with 1 where docs/ differs")
    options = parser.parse_args()
    status = 0
    for document, name, text in sections:
        if options.write:
            put(DOCS / document, name, text)
        elif not options.check:
            print(f"{document}, {name}:\n\n{text}\n")
        elif between(DOCS / document, name) != text:
            print(f"docs/{document}: {name} is out of date: run {command}", file=sys.stderr)
            status = 1
    return status


def _page_with(name: str) -> Path | None:
    """Return the page that shows the table of `name`; None for a table that no page shows."""
    for page in sorted(DOCS.rglob("*.md")):
        if f"<!-- {name}: begin -->" in page.read_text(encoding="utf-8"):
            return page
    return None


def _parted(document: Path, name: str) -> tuple[str, str, str]:
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, opening, rest = document.read_text(encoding="utf-8").partition(begin)
    text, ended, after = rest.partition(end)
    if not (opening and ended):
        raise SystemExit(f"{document}: the markers {begin} and {end} are needed")
    return before + begin, text, end + after


def quantile(values: Sequence[float], share: float) -> float:
    """Return the value that a fraction `share` of all values does not exceed."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def quantile_of_rounds(rounds: Iterable[Sequence[float]], share: float) -> float:
    """Return that quantile of all values of several rounds."""
    return quantile([value for values in rounds for value in values], share)


def quantile_ratio(
    rounds: Sequence[Sequence[float]], reference: Sequence[Sequence[float]], share: float = 0.99
) -> str:
    """Return the ratio of two quantiles and its 95 % interval, a bootstrap over rounds.

    Round n of both is from the same time.
    """
    chosen = [
        range(len(rounds)),
        *np.random.default_rng(0).integers(len(rounds), size=(1000, len(rounds))),
    ]
    ratio, *drawn = (
        quantile_of_rounds([rounds[n] for n in numbers], share)
        / quantile_of_rounds([reference[n] for n in numbers], share)
        for numbers in chosen
    )
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{ratio:.2f} ({low:.2f} to {high:.2f})"


def percent(share: float) -> str:
    """Format a fraction in % with one decimal."""
    return f"{round(100 * share, 1) + 0.0:.1f}"  # no negative zero
