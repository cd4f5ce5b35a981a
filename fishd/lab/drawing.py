"""Figures in one style, without a display; equal data give equal files."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fishd.core import text
from fishd.core.errors import FishdError, MissingPackage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 200
MAX_LABEL_CHARS = 120
"""Length of the longest label in a figure that comes from user input [characters]."""
FORMATS = (".pdf", ".png", ".svg")
BLACK, BLUE, ORANGE, GREEN, PURPLE = "#1a1a1a", "#0072b2", "#d55e00", "#009e73", "#aa4499"
"""Colours that differ in grey and for the colour-blind (Okabe and Ito), darkest first."""
YELLOW = "#e69f00"
"""Colour of the second curve of a pair whose first one is ORANGE."""
GREY = "0.55"
"""Grey level of a reference curve."""
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "svg.hashsalt": "fishd",  # else the identifiers within an .svg differ from run to run
}


def check_installed() -> None:
    """Raise `MissingPackage` without matplotlib (extra: lab)."""
    if find_spec("matplotlib") is None:
        raise MissingPackage.of_extra("a figure", "matplotlib", "lab")


def check(path: str | os.PathLike[str]) -> None:
    """Raise `FishdError` where no figure can be written there, before anything is computed.

    Raises `MissingPackage` without matplotlib (extra: lab).
    """
    check_installed()
    file = Path(path)
    if file.suffix.lower() not in FORMATS:
        kind = file.suffix or "without a suffix"
        raise FishdError(
            f"{file}: a figure has no format {kind}: {', '.join(FORMATS[:-1])} or {FORMATS[-1]} "
            "is needed"
        )
    if not file.parent.is_dir():
        raise FishdError(
            f"{file}: the figure cannot be written: the folder {file.parent} does not exist"
        )


def plain(words: str) -> str:
    """Return user input as a line of text in which matplotlib finds no mathematics."""
    return text.line(words, MAX_LABEL_CHARS).replace("$", r"\$")


def load_matplotlib() -> None:
    """Import matplotlib without the settings of the user; call it before any other import of it.

    They may be for another program, as the backend of a Jupyter notebook is, or damaged: each
    error in them would end the import. A `matplotlibrc` in the working folder may be of any other
    user. Raises `MissingPackage` without matplotlib (extra: lab).
    """
    check_installed()
    if "matplotlib" in sys.modules:
        return  # `open_figure` replaces its settings
    spec = find_spec("matplotlib")
    assert spec
    assert spec.origin
    folder = os.open(".", os.O_PATH | os.O_DIRECTORY)  # it may have been removed
    backend = os.environ.pop("MPLBACKEND", None)
    try:
        os.chdir(Path(spec.origin).with_name("mpl-data"))  # has the file of the defaults
        import matplotlib  # noqa: F401
    finally:
        os.fchdir(folder)
        os.close(folder)
        if backend is not None:
            os.environ["MPLBACKEND"] = backend


@contextmanager
def open_figure(path: str | os.PathLike[str], size: tuple[float, float]) -> Iterator["Figure"]:
    """Provide a figure of `size` (width and height, inch), and write it to a file at the end.

    path: its suffix chooses the format, one of `FORMATS`; no file contains a date
    Raises the errors of `check`, and `FishdError` where writing fails.
    """
    check(path)
    load_matplotlib()
    from matplotlib import rc_context, rcParamsDefault
    from matplotlib.figure import Figure

    # `rcdefaults` would read the style files of the user.
    defaults = {name: rcParamsDefault[name] for name in rcParamsDefault if name != "backend"}
    with rc_context(defaults | _STYLE):
        figure = Figure(figsize=size, layout="constrained")
        yield figure
        save(figure, Path(path))


def save(figure: "Figure", path: Path) -> None:
    """Write a figure; raises `FishdError`."""
    dates: dict[str, Any] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    try:
        figure.savefig(path, dpi=DOTS_PER_INCH, metadata=dates.get(path.suffix.lower()))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise FishdError(f"{path}: the figure cannot be written: {why}") from None
