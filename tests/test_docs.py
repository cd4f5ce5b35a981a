"""The documentation against the program: links, verbs, options, keys, faults, reasons, messages."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest
import yaml

from fishd.cli.checks import CHECKS
from fishd.cli.main import fishctl
from fishd.config import Config, load
from fishd.daemon import fishd
from fishd.emulation.faults import FAULTS
from fishd.errors import UnknownController
from fishd.schema import fields_of, leaves

ROOT = Path(__file__).parent.parent
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
OPERATORS = [ROOT / "docs" / f"{name}.md" for name in (
    "calibration", "configuration", "getting-started", "installing", "protocol", "troubleshooting",
    "virtual-pi", "wiring",
)]  # fmt: skip
each_document = pytest.mark.parametrize("document", DOCS, ids=lambda path: path.name)

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_SPAN = re.compile(r"`([^`\n]+)`")
_LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)")


def text_of(document: Path) -> str:
    return document.read_text(encoding="utf-8")


def prose_of(document: Path) -> str:
    return _FENCE.sub("", text_of(document))


def code_of(document: Path) -> Iterator[str]:
    """Each line of a fenced block, continued ones joined, and each code span."""
    for _, block in _FENCE.findall(text_of(document)):
        yield from block.replace("\\\n", " ").splitlines()
    yield from _SPAN.findall(prose_of(document))


@cache
def anchors_of(document: Path) -> frozenset[str]:
    """The anchors of its headings, as Git hosts make them."""
    found: list[str] = []
    for heading in re.findall(r"^#+ (.+)$", prose_of(document), re.MULTILINE):
        plain = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        found.append(plain + (f"-{found.count(plain)}" if plain in found else ""))
    return frozenset(found)


@each_document
def test_every_relative_link_leads_somewhere(document: Path) -> None:
    broken = []
    for link in _LINK.findall(prose_of(document)):
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        if ":" in path or (target.exists() and not anchor):
            continue
        if not target.exists() or anchor not in anchors_of(target):
            broken.append(link)
    assert not broken


def complaint(command: click.Command, words: list[str]) -> str | None:
    """What is wrong with a command line; None where every verb and option of it exists."""
    path = command.name or ""
    context = click.Context(command)
    options = {name for param in command.params for name in param.opts + param.secondary_opts}
    for word in words:
        if word.startswith("--"):
            if word.partition("=")[0] not in options | {"--help", "--version"}:
                return f"{path} has no {word}"
        elif isinstance(command, click.Group) and not word.startswith("-"):
            try:
                found = command.get_command(context, word)
            except UnknownController:
                return None  # of a package that is not installed here
            if found is None:
                return None if re.fullmatch(r"[A-Z|.]+", word) else f"{path} has no verb {word}"
            command, path = found, f"{path} {word}"
            context = click.Context(command, parent=context)
            options |= {name for param in command.params for name in param.opts}
    return None


def command_lines(document: Path, program: str) -> Iterator[list[str]]:
    """The words after each call of a program."""
    for line in code_of(document):
        for call in re.split(r"[|;&#$(]", line):
            words = call.split()
            while words and words[0].split("/")[-1] != program:
                if words[0] not in ("sudo", "-u", "fishd", "eval") and "=" not in words[0]:
                    words = []
                words = words[1:]
            if words and not words[0].startswith(("/", "docs", "config")):
                yield [word.strip("\"'`,.") for word in words[1:]]


@each_document
@pytest.mark.parametrize("program", [fishctl, fishd], ids=["fishctl", "fishd"])
def test_every_verb_and_option_of_a_command_line_exists(
    document: Path, program: click.Command
) -> None:
    lines = command_lines(document, program.name or "")
    problems = [found for words in lines if (found := complaint(program, words))]
    assert not problems


def test_the_docs_show_command_lines_at_all() -> None:
    shown = {words[0] for path in DOCS for words in command_lines(path, "fishctl") if words}
    assert set(fishctl.list_commands(click.Context(fishctl))) <= shown


def options_of(command: click.Command, context: click.Context) -> Iterator[str]:
    for param in command.params:
        yield from (*param.opts, *param.secondary_opts)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found
            yield from options_of(found, click.Context(found, parent=context))


@pytest.mark.parametrize("document", OPERATORS, ids=lambda path: path.name)
def test_every_option_that_is_named_alone_belongs_to_some_verb(document: Path) -> None:
    known = {o for program in (fishctl, fishd) for o in options_of(program, click.Context(program))}
    named = re.findall(r"`(--[a-z-]+)", prose_of(document))
    assert not set(named) - known - {"--"}


@each_document
def test_every_configuration_key_that_is_named_exists(document: Path) -> None:
    known = set(leaves(Config))
    sections = "|".join(field.name for field in fields_of(Config) if field.kind == "section")
    key = re.compile(rf"(?<![\w./-])(?:{sections})(?:\.[a-z_0-9]+)+(?![\w/(])")
    named = {found for code in code_of(document) for found in key.findall(code)}
    modules = {f"{field.name}.py" for field in fields_of(Config)}
    wrong = {name for name in named - known - modules if not name.startswith("start.parameters.")}
    if document.name == "configuration.md":
        wrong -= {"plant.omega"}  # an example of a mistake
    if document.name == "troubleshooting.md":
        wrong -= {"servo.gpoi"}
    assert not wrong


def configurations() -> Iterator[tuple[str, str]]:
    """The YAML blocks that are, or could be, a configuration."""
    keys = {field.name for field in fields_of(Config)}
    for document in DOCS:
        blocks = [block for kind, block in _FENCE.findall(text_of(document)) if kind == "yaml"]
        for number, block in enumerate(blocks, 1):
            if keys & set(yaml.safe_load(block)):
                yield f"{document.name}-{number}", block


@pytest.mark.parametrize("block", [pytest.param(b, id=name) for name, b in configurations()])
def test_every_configuration_that_is_shown_is_good(block: str, tmp_path: Path) -> None:
    file = tmp_path / "shown.yaml"
    file.write_text(block, encoding="utf-8")
    load(file)


def first_cells(document: Path, heading: str) -> list[str]:
    """The code in the first column of the tables below a heading, down to the next one."""
    section = re.split(rf"^#+ {re.escape(heading)}$", text_of(document), flags=re.MULTILINE)[1]
    section = re.split(r"^#", section, flags=re.MULTILINE)[0]
    return re.findall(r"^\| `([^`]+)`", section, re.MULTILINE)


def test_the_table_of_faults_has_each_fault_of_the_virtual_pi_in_its_order() -> None:
    assert first_cells(ROOT / "docs" / "virtual-pi.md", "Break it") == list(FAULTS)


def test_the_table_of_checks_has_each_check_of_doctor_in_its_order() -> None:
    table = first_cells(ROOT / "docs" / "troubleshooting.md", "Lines of doctor")
    assert [name for name in table if " " not in name or name in {c.name for c in CHECKS}] == [
        check.name for check in CHECKS
    ]


def sources() -> Iterator[str]:
    for path in sorted((ROOT / "fishd").rglob("*.py")):
        yield path.read_text(encoding="utf-8")


def reason_codes() -> set[str]:
    """Every code that a fault or an emergency stop can have, in the loop's sources."""
    code = re.compile(r"(?:\bfail\(|_fail\(|Reason\(code=)\s*\"([a-z-]+)\"")
    return {found for text in sources() for found in code.findall(text)}


def test_troubleshooting_has_a_section_for_each_reason_and_no_other() -> None:
    document = text_of(ROOT / "docs" / "troubleshooting.md")
    section = document.split("## By reason")[1].split("\n## ")[0]
    assert set(re.findall(r"^### (\S+)$", section, re.MULTILINE)) == reason_codes()


def test_concepts_lists_each_reason() -> None:
    text = text_of(ROOT / "docs" / "concepts.md")
    assert {code for code in reason_codes() if f"`{code}`" not in text} == set()


@cache
def templates() -> tuple[re.Pattern[str], ...]:
    """What the sources can print: each text of some length, with `.+` for what is put into it."""
    found = set()
    for text in sources():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                pieces = re.split(r"\{\w+(?::[^}]*)?\}", node.value)
            elif isinstance(node, ast.JoinedStr):
                pieces = [part.value if isinstance(part, ast.Constant) else "\0"
                          for part in node.values]  # fmt: skip
                pieces = "".join(map(str, pieces)).split("\0")
            else:
                continue
            if len("".join(pieces)) >= 15 and "\n" not in "".join(pieces):
                found.add(".+".join(re.escape(piece) for piece in pieces))
    return tuple(map(re.compile, sorted(found)))


def quoted_messages() -> Iterator[str]:
    """What troubleshooting.md says that fishd prints: tables of messages and lines, text blocks."""
    document = text_of(ROOT / "docs" / "troubleshooting.md")
    for kind, block in _FENCE.findall(document):
        if kind == "text":
            yield from block.splitlines()
    for table in re.findall(r"^\| (?:message|line) \|.*\n\|[-|]+\n((?:\|.*\n)+)", document, re.M):
        yield from re.findall(r"^\| `([^`]+)`", table, re.MULTILINE)


@pytest.mark.parametrize("line", quoted_messages())
def test_every_message_that_is_quoted_is_one_that_fishd_prints(line: str) -> None:
    # A message may come with what is put in front of it or behind it by another template.
    assert any(
        len(found[0]) >= 0.6 * len(line) for found in map(lambda t: t.search(line), templates())
        if found
    )  # fmt: skip
