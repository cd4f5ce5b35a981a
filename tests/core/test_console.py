"""What a program says in a terminal as it ends."""

import click
import pytest

from fishd.core import console


@pytest.mark.parametrize("how", [KeyboardInterrupt, EOFError])
def test_a_command_that_is_interrupted_says_so(
    how: type[BaseException],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @click.command()
    def computes() -> None:
        raise how

    monkeypatch.setattr("sys.argv", ["fishctl"])
    with pytest.raises(SystemExit) as ended:
        console.run(computes, "fishctl")
    assert ended.value.code == console.INTERRUPTED
    assert capsys.readouterr().err.strip() == "fishctl: interrupted"
