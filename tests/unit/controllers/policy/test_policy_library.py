"""Names of policies: which folders they are looked for in, and in which order."""

import os
from pathlib import Path

import pytest
from rigs.harness import LIMITS
from rigs.policy_files import card, linear, write

from fishd.controllers import registry
from fishd.controllers.policy import library
from fishd.controllers.policy.network import to_onnx
from fishd.core.errors import ParameterError, PolicyError


@pytest.fixture(autouse=True)
def no_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nothing of this machine, and nothing that ships, has a name here."""
    for variable in ("FISHD_POLICIES", "STATE_DIRECTORY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(library, "_SYSTEM", tmp_path / "system")
    monkeypatch.setattr(library, "_shipped_folder", lambda: tmp_path / "shipped")


def test_the_folders_are_those_of_the_variable_the_state_the_system_and_the_package(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("FISHD_POLICIES", os.pathsep.join(["/a", "", "/b"]))
    rest = [tmp_path / "system", tmp_path / "shipped"]
    assert library.folders() == [
        Path("/a"), Path("/b"), tmp_path / "state" / "fishd" / "policies", *rest
    ]  # fmt: skip
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/fishd:/var/lib/other")
    assert library.folders()[2] == Path("/var/lib/fishd/policies")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setenv("HOME", "/home/somebody")
    assert library.folders()[2] == Path("/home/somebody/.local/state/fishd/policies")


def test_the_first_folder_with_a_name_wins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("FISHD_POLICIES", str(tmp_path / "mine"))
    shipped = write(tmp_path / "shipped", name="swim")
    assert library.find("swim") == shipped
    system = write(tmp_path / "system", name="swim")
    assert library.find("swim") == system
    state = write(tmp_path / "state" / "fishd" / "policies", name="swim")
    assert library.find("swim") == state
    mine = write(tmp_path / "mine", name="swim")
    assert library.find("swim") == mine
    assert library.names() == ["swim"]


def test_only_policy_files_with_printable_names_have_a_name(tmp_path: Path) -> None:
    for name in ("b", "a", ".part", "esc\x1b[2J"):
        write(tmp_path / "shipped", name=name)
    (tmp_path / "shipped" / "README.md").write_text("no policy")
    assert library.names() == ["a", "b"]


def test_a_slash_or_the_suffix_makes_it_a_path(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("./swim", "swim.onnx", "/x/swim"):
        assert library.find(text) == Path(text)
    monkeypatch.setenv("HOME", "/home/somebody")
    assert library.find("~/swim.onnx") == Path("/home/somebody/swim.onnx")


def test_an_unknown_name_gets_the_nearest_and_the_list(tmp_path: Path) -> None:
    for name in ("swim42", "calm"):
        write(tmp_path / "shipped", name=name)
    with pytest.raises(PolicyError) as caught:
        library.find("swim4")
    refused = "no policy is named 'swim4'; did you mean 'swim42'? There are: calm, swim42"
    assert str(caught.value) == refused
    with pytest.raises(PolicyError) as caught:
        library.find("zebra")
    assert str(caught.value) == "no policy is named 'zebra'; valid: calm, swim42"


def test_where_there_are_none_it_says_where_to_put_one(tmp_path: Path) -> None:
    with pytest.raises(PolicyError) as caught:
        library.find("swim")
    assert str(caught.value) == (
        "no policy is named 'swim', and none is installed; put one into "
        f"{tmp_path}/state/fishd/policies, or give the path of a .onnx file"
    )


def test_the_controller_takes_names(tmp_path: Path) -> None:
    write(tmp_path / "shipped", name="swim")
    assert registry.create("ppo", {"policy": "swim"}, LIMITS).parameters.policy == "swim"
    with pytest.raises(ParameterError, match="ppo: policy: no policy is named 'swam'"):
        registry.check("ppo", {"policy": "swam"}, LIMITS)


def test_each_is_described_with_its_card_or_what_is_wrong_with_it(tmp_path: Path) -> None:
    folder = tmp_path / "shipped"
    write(folder, name="good")
    write(folder, to_onnx(linear(1.0), "tanh", card(tick=0.02)), name="quick")
    write(folder, b"PK", name="torch")
    good, quick, torch = library.describe_all(LIMITS)
    assert (good.name, good.file, good.problem) == ("good", str(folder / "good.onnx"), "")
    assert good.card["provenance"]["steps"] == 8000
    assert quick.card
    assert quick.problem.startswith("it was trained at a tick of 20 ms, this robot's is 50 ms")
    assert torch.card is None
    assert torch.problem.startswith("this is a zip archive as torch writes")
    assert not any(info.problem for info in library.describe_all()[:2])  # without a robot


def test_a_folder_that_cannot_be_read_hides_no_other(tmp_path: Path) -> None:
    (tmp_path / "system").write_text("a file where a folder should be")
    write(tmp_path / "shipped", name="swim")
    assert library.names() == ["swim"]
