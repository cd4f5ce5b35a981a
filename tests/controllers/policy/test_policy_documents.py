"""docs/policies.md against the program."""

from rigs.documents import ROOT, first_cells, text_of

from fishd.controllers.policy import checksum, file, library, operators
from fishd.controllers.policy.card import FORMAT, KEY, Card, Provenance
from fishd.core.schema import fields_of

DOCUMENT = ROOT / "docs" / "policies.md"


def test_each_key_of_the_card_is_described() -> None:
    table = first_cells(DOCUMENT, "What is in a policy file")
    assert table == [field.name for field in fields_of(Card)]
    text = text_of(DOCUMENT)
    assert f"| `format` | | {FORMAT} |" in text
    assert all(f"`{field.name}`" in text for field in fields_of(Provenance))


def test_names_of_files_ends_and_folders_are_right() -> None:
    text = text_of(DOCUMENT)
    for word in (
        KEY,
        checksum.KEY,
        file.INPUT,
        file.OUTPUT,
        library.SUFFIX,
        f"${library.FOLDERS_VARIABLE}",
    ):
        assert f"`{word}`" in text or f"`{word} " in text or f"metadata `{word}`" in text
    assert f"more than {file.LARGEST // 2**20} MB" in text
    assert "/etc/fishd/policies" in text


def test_each_permitted_operator_is_listed() -> None:
    text = text_of(DOCUMENT)
    for what, names in operators.PERMITTED.items():
        assert f"| {what} | {', '.join(f'`{name}`' for name in sorted(names))} |" in text
    assert f"versions {operators.OPSETS[0]} to {operators.OPSETS[-1]}:" in text
    assert f"more than {operators.LARGEST_NODES} operators, 10⁸ multiplications" in text
    assert operators.LARGEST_WORK == 10**8
