"""Settings of matplotlib that are for other programs, or damaged, change no figure."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

DRAW = """
import sys
if "imported" in sys.argv:
    import matplotlib
    matplotlib.rcParams.update({"text.usetex": True, "figure.facecolor": "red"})
from fishd.lab.drawing import open_figure
with open_figure(sys.argv[1], (2.0, 1.0)) as figure:
    axes = figure.subplots()
    axes.plot([0.0, 1.0], [0.0, 1.0])
    axes.set_title("$F_x$ (mN) # 50 %")
"""
USETEX = "text.usetex: True\naxes.facecolor: red\n"


def draw(folder: Path, *arguments: str, **environment: str) -> bytes:
    """Draw a figure in a process in this folder; return its file."""
    command = [sys.executable, "-P", "-c", DRAW, "figure.svg", *arguments]
    subprocess.run(command, cwd=folder, env=os.environ | environment, check=True)
    return (folder / "figure.svg").read_bytes()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return draw(tmp_path_factory.mktemp("plain"))


def test_the_backend_of_a_notebook_is_for_the_notebook(tmp_path: Path, plain: bytes) -> None:
    assert draw(tmp_path, MPLBACKEND="module://matplotlib_inline.backend_inline") == plain


@pytest.mark.parametrize("content", [USETEX.encode(), b"axes.titlecolor: red # caf\xe9\n"])
@pytest.mark.parametrize(
    ("folder", "variable"),
    [("", "ANY"), ("home/matplotlib", "XDG_CONFIG_HOME"), ("home/matplotlib", "MATPLOTLIBRC")],
)
def test_settings_in_the_working_folder_or_of_the_user_are_not_for_fishd(
    folder: str, variable: str, content: bytes, tmp_path: Path, plain: bytes
) -> None:
    settings = tmp_path / folder
    settings.mkdir(parents=True, exist_ok=True)
    (settings / "matplotlibrc").write_bytes(content)
    path = settings.parent if variable == "XDG_CONFIG_HOME" else settings
    assert draw(tmp_path, **{variable: str(path)}) == plain


@pytest.mark.parametrize("style", [b"# f\xfcr die Fische\n", b"font.sizee: 10\n"])
def test_the_style_files_of_the_user_are_not_read(
    style: bytes, tmp_path: Path, plain: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    styles = tmp_path / "home" / "matplotlib" / "stylelib"
    styles.mkdir(parents=True)
    (styles / "lab.mplstyle").write_bytes(style)
    assert draw(tmp_path, XDG_CONFIG_HOME=str(tmp_path / "home")) == plain
    assert capfd.readouterr().err == ""


def test_a_program_that_has_changed_them_gets_the_same_figure(tmp_path: Path, plain: bytes) -> None:
    assert draw(tmp_path, "imported") == plain
