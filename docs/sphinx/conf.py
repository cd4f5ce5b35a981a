"""Settings of Sphinx: the pages of docs/ and the API as a web site, the commands as man pages too.

`make docs` runs it. The pages stay plain Markdown, as Git hosts show them.
"""

import re
from typing import Any

import click
from sphinx.ext.autodoc import mock

from fishd import __version__
from fishd.cli.main import fishctl

project = "fishd"
version = release = __version__
copyright = "The fishd authors"
language = "en"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_click"]
root_doc = "README"
exclude_patterns = ["example-*", "notebooks"]
html_theme = "furo"
html_title = f"fishd {version}"
html_show_sphinx = False
html_copy_source = False
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
man_pages = [
    (f"sphinx/{name}", name, about, "", 1)
    for name, about in {
        "fishd": "run a robotic fish",
        "fishctl": "talk to fishd, the daemon that runs a robotic fish",
        "fishd-window": "serve a page of the fish for people at the tank",
        "fishd-camera": "publish the frames of the camera above the tail",
    }.items()
]
_CONTENTS = """
```{toctree}
:hidden:
:glob:
:titlesonly:

tutorial/*
how-to/*
reference/*
explanation/*
decisions/README
sphinx/api
sphinx/commands
```
"""


def _add_contents(_app: Any, page: str, source: list[str]) -> None:
    """Add the table of contents of the site, which a Git host would show as code."""
    if page == "README":
        source[0] += _CONTENTS
    if page == "decisions/README":
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"


def _escape(paragraph: str) -> str:
    code, parts = False, []
    for part in paragraph.split("`"):
        parts.append(f"``{part}``" if code else re.sub(r"([*|\\]|_\b)", r"\\\1", part))
        code = not code
    return "".join(parts)


def _plain_text(*arguments: Any) -> None:
    """Turn docstrings and help, which are plain text with `code`, into reStructuredText."""
    lines = arguments[-1]
    blocks = re.split(r"\n\s*\n", "\n".join(lines))
    lines[:] = []
    for block in blocks:
        if re.search(r"^ ", block, re.MULTILINE):
            block = "::\n\n   " + block.replace("\n", "\n   ")
        else:
            block = _escape(block)
        lines += [*block.splitlines(), ""]


def _options(_app: Any, _context: Any, lines: list[str]) -> None:
    """Escape the asterisks in the help of options, as in *.onnx."""
    lines[:] = [line.replace("*", r"\*") for line in lines]


def _import_verbs(group: click.Group) -> None:
    """Import the verbs of a group, which are imported only when they are called otherwise."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command
        group.commands[name] = command
        if isinstance(command, click.Group):
            _import_verbs(command)


def setup(app: Any) -> None:
    """Import the verbs, and connect the functions above."""
    with mock(["numba"]):  # slow to install, and not needed for the pages
        _import_verbs(fishctl)
    app.connect("source-read", _add_contents)
    app.connect("autodoc-process-docstring", _plain_text)
    app.connect("sphinx-click-process-description", _plain_text)
    app.connect("sphinx-click-process-options", _options)
