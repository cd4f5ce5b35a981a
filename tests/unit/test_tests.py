"""The tests themselves: what they share stands in helper modules, not in one another."""

import re

from rigs.documents import ROOT


def test_no_test_module_imports_another() -> None:
    importing = re.compile(r"^\s*(?:from|import) (?:\w+\.)*test_\w+", re.MULTILINE)
    files = sorted((ROOT / "tests").rglob("*.py"))
    assert [str(file) for file in files if importing.search(file.read_text("utf-8"))] == []
