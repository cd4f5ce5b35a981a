"""The documentation against the program: links, verbs, options, keys, faults, policies."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import click
import pytest
import yaml
from rigs.documents import DOCS, FENCE, ROOT, code_of, first_cells, prose_of, text_of

from deb.package import COMMANDS, CONFIGS, HOME, SYSTEM_FILES
from fishd.camera.main import camera
from fishd.cli.controller_arguments import ControllerGroup, ControllersCommand, join_parameters
from fishd.cli.doctor import checks
from fishd.cli.doctor.base import Context
from fishd.cli.main import fishctl
from fishd.config import Config, keys, load
from fishd.controllers.policy import file, library
from fishd.controllers.policy.card import CARD_KEY, FORMAT, Card, Provenance
from fishd.core.errors import UnknownController
from fishd.core.schema import fields_of
from fishd.daemon.main import fishd
from fishd.virtual.pi.faults import FAULTS
from fishd.window.main import window

OPERATORS = [path for path in DOCS if path.stem in (
    "calibration", "configuration", "getting-started", "install", "protocol", "troubleshooting",
    "virtual-pi", "wiring",
)]  # fmt: skip
POWERED_ROBOT = ["robot=pi", "sensors.power.kind=ina219"]
ADDED_BY_EXAMPLES = {"beat", "estimator.fy_offset", "estimator.fy_offset=0.02"}
"""Verb and key that the examples of contributing.md add, which test_contributing.py applies."""

_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


@cache
def anchors_of(document: Path) -> frozenset[str]:
    """Return the anchors of a document's headings, as Git hosts make them."""
    anchors: list[str] = []
    for heading in re.findall(r"^#+ (.+)$", prose_of(document), re.MULTILINE):
        plain = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        anchors.append(plain + (f"-{anchors.count(plain)}" if plain in anchors else ""))
    return frozenset(anchors)


def test_every_relative_link_leads_somewhere() -> None:
    broken = []
    for document in DOCS:
        for link in _LINK.findall(prose_of(document)):
            path, _, anchor = link.partition("#")
            target = (document.parent / path).resolve() if path else document
            if ":" in path or (target.exists() and not anchor):
                continue
            if not target.exists() or anchor not in anchors_of(target):
                broken.append((document.name, link))
    assert not broken


def find_mistake(command: click.Command, words: list[str]) -> str | None:
    """Return the first mistake of a command line; None if all its verbs and options are right."""
    path = command.name or ""
    context = click.Context(command)
    flags = {"--help": True, "--version": True} | flags_of(command)
    rest = iter(words)
    for word in rest:
        if word == "--resume" and isinstance(command, ControllerGroup):  # its controller is kept
            command = command.get_command(context, "square") or command
            flags |= flags_of(command)
        if word.startswith("--"):
            name, equals, _ = word.partition("=")
            if name not in flags:
                return f"{path} has no {word}"
            if not flags[name] and not equals:
                next(rest, None)
        elif isinstance(command, click.Group):
            try:
                subcommand = command.get_command(context, word)
            except UnknownController:
                return None  # of a package that is not installed here
            if subcommand is None:
                return None if re.fullmatch(r"[A-Z|.]+", word) else f"{path} has no verb {word}"
            command, path = subcommand, f"{path} {word}"
            context = click.Context(command, parent=context)
            flags |= flags_of(command)
            if isinstance(command, ControllersCommand):
                rest = iter(join_parameters(context, list(rest)))
    needed = [param.opts[0] for param in command.params if is_needed(param)]
    if needed and not {*needed, "--resume", "--help"} & {word.partition("=")[0] for word in words}:
        return f"{path} needs {needed[0]}"
    return None


def is_needed(param: click.Parameter) -> bool:
    return isinstance(param, click.Option) and param.required


def flags_of(command: click.Command) -> dict[str, bool]:
    """Return the options of a command, and whether each takes no value."""
    return {
        name: bool(getattr(param, "is_flag", False))
        for param in command.params
        for name in (*param.opts, *param.secondary_opts)
    }


def command_lines(document: Path, program: str) -> Iterator[list[str]]:
    """Yield the words after each call of a program."""
    for line in code_of(document):
        for call in re.split(r"[|;&#$(]", line):
            words = call.split()
            while words and words[0].split("/")[-1] != program:
                if words[0] not in ("sudo", "-u", "fishd", "eval") and "=" not in words[0]:
                    words = []
                words = words[1:]
            if words and not words[0].startswith(("/", "docs", "config")):
                yield [word.strip("\"'`,.") for word in words[1:]]


def test_each_verb_and_option_of_a_command_exists_and_none_is_missing() -> None:
    problems = [
        (document.name, mistake)
        for document in DOCS
        for program in (fishctl, fishd, camera, window)
        for words in command_lines(document, program.name or "")
        if not ADDED_BY_EXAMPLES & set(words) and (mistake := find_mistake(program, words))
    ]
    assert not problems


def test_the_docs_show_command_lines_at_all() -> None:
    shown = {words[0] for path in DOCS for words in command_lines(path, "fishctl") if words}
    assert set(fishctl.list_commands(click.Context(fishctl))) <= shown


def options_of(command: click.Command, context: click.Context) -> Iterator[str]:
    for param in command.params:
        yield from (*param.opts, *param.secondary_opts)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            subcommand = command.get_command(context, name)
            yield from options_of(subcommand, click.Context(subcommand, parent=context))


def test_every_option_that_is_named_alone_belongs_to_some_verb() -> None:
    known = {o for program in (fishctl, fishd) for o in options_of(program, click.Context(program))}
    for document in OPERATORS:
        named = re.findall(r"`(--[a-z-]+)", prose_of(document))
        assert not set(named) - known - {"--"}, document.name


def test_every_configuration_key_that_is_named_exists() -> None:
    sections = "|".join(field.name for field in fields_of(Config) if field.kind == "section")
    key = re.compile(rf"(?<![\w./-])(?:{sections})(?:\.[a-z_0-9]+)+(?![\w/(])")
    known = {*keys(), *(f"{field.name}.py" for field in fields_of(Config)), *ADDED_BY_EXAMPLES}
    mistakes = {"configuration.md": {"plant.omega"}, "troubleshooting.md": {"servo.gpoi"}}
    for document in DOCS:
        named = {key_path for code in code_of(document) for key_path in key.findall(code)}
        named = {re.sub(r"^sensors\.[a-z_]+", "sensors.NAME", key_path) for key_path in named}
        unknown = named - known - mistakes.get(document.name, set())
        wrong = {name for name in unknown if not name.startswith("start.parameters.")}
        assert not wrong, document.name


def configurations() -> Iterator[tuple[str, str]]:
    """Yield a name and the text of each YAML block that is, or could be, a configuration."""
    keys = {field.name for field in fields_of(Config)}
    for document in DOCS:
        if document.name == "writing-a-controller.md":
            continue  # its configuration needs the controller that it is about
        blocks = [block for kind, block in FENCE.findall(text_of(document)) if kind == "yaml"]
        for number, block in enumerate(blocks, 1):
            if keys & set(yaml.safe_load(block)):
                yield f"{document.name}-{number}", block


@pytest.mark.parametrize("block", [pytest.param(b, id=name) for name, b in configurations()])
def test_every_configuration_that_is_shown_is_good(block: str, tmp_path: Path) -> None:
    file = tmp_path / "shown.yaml"
    file.write_text(block, encoding="utf-8")
    load(file)


def test_the_table_of_faults_has_each_fault_of_the_virtual_pi_in_its_order() -> None:
    assert first_cells(ROOT / "docs" / "how-to" / "virtual-pi.md", "Inject faults") == list(FAULTS)


def test_the_table_of_checks_names_checks_of_doctor_in_its_order() -> None:
    table = first_cells(ROOT / "docs" / "how-to" / "troubleshooting.md", "Lines of doctor")
    names = [check.name for check in checks(Context(load(None, POWERED_ROBOT)))]
    assert table
    assert [name for name in names if name in table] == table


DOCUMENT = ROOT / "docs" / "reference" / "policies.md"


def test_each_key_of_the_card_is_described() -> None:
    table = first_cells(DOCUMENT, "What is in a policy file")
    assert table == [field.name for field in fields_of(Card)]
    text = text_of(DOCUMENT)
    assert f"| `format` | | {FORMAT} |" in text
    assert all(f"`{field.name}`" in text for field in fields_of(Provenance))


def test_names_of_files_ends_and_folders_are_right() -> None:
    text = text_of(DOCUMENT)
    words = (CARD_KEY, file.CHECKSUM_KEY, file.INPUT, file.OUTPUT, library.SUFFIX)
    for word in (*words, f"${library.FOLDERS_VARIABLE}"):
        assert f"`{word}`" in text or f"`{word} " in text or f"metadata `{word}`" in text
    assert f"more than {file.MAX_FILE_BYTES // 2**20} MB" in text
    assert "/etc/fishd/policies" in text


def test_each_permitted_operator_is_listed() -> None:
    text = text_of(DOCUMENT)
    for what, names in file.PERMITTED.items():
        assert f"| {what} | {', '.join(f'`{name}`' for name in sorted(names))} |" in text
    assert f"versions {file.OPSETS[0]} to {file.OPSETS[-1]}:" in text
    assert f"more than {file.MAX_NODES} operators" in text


def test_installing_lists_all_files_and_groups_that_come_onto_a_pi() -> None:
    users = (ROOT / "systemd/sysusers.d/fishd.conf").read_text()
    table = text_of(ROOT / "docs/how-to/install.md").split("It installs:")[1].split("\n\n")[1]
    wanted = {f"`/{HOME}`", *(f"`/usr/bin/{name}`" for name in COMMANDS)}
    wanted |= {f"`/etc/fishd/{name}.yaml`" for name in CONFIGS.values()}
    for pattern, folder in SYSTEM_FILES.items():
        wanted |= {f"`/{folder}/{file.name}`" for file in (ROOT / "systemd").glob(pattern)}
    assert len(wanted) > 16
    wanted |= set(re.findall(r"(?m)^m fishd (\w+)$", users))
    assert {name for name in wanted if name not in table} == set()
