"""Entry points of the commands; a Ctrl-C while a command is loading ends it without a traceback."""

import os
import sys


def _exclude_working_directory() -> None:
    """Import nothing from the working directory from now on, in this process or its children.

    `python -m fishd` puts that folder first. Only `python -P -m fishd` also protects the modules
    that Python itself loads earlier, such as `runpy`. Folders in PYTHONPATH are kept.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        folder = os.getcwd()  # noqa: PTH109 (pathlib is not loaded yet)
    except OSError:  # it was deleted
        folder = ""
    if not sys.flags.safe_path and sys.path and sys.path[0] in ("", folder):
        del sys.path[0]


_exclude_working_directory()
try:
    import gc
    import signal
    from collections.abc import Iterator
    from contextlib import contextmanager, suppress
except KeyboardInterrupt:
    raise SystemExit(130) from None


def fishd() -> None:
    """Run the `fishd` command."""
    _prepare()
    with _loading():
        from fishd.daemon.main import main
    main()


def fishctl() -> None:
    """Run the `fishctl` command."""
    _prepare()
    with _loading():
        from fishd.cli.main import main
    main()


def fishd_camera() -> None:
    """Run the `fishd-camera` command."""
    _prepare()
    with _loading():
        from fishd.camera.main import main
    main()


def fishd_window() -> None:
    """Run the `fishd-window` command."""
    _prepare()
    with _loading():
        from fishd.window.main import main
    main()


def _prepare() -> None:
    """Correct unusual conditions in which a command was started."""
    _open_closed_streams()
    _use_utf8()


def _open_closed_streams() -> None:
    """Open standard streams that were closed, so that no other file gets their descriptors.

    Writing to such a standard output fails as on any descriptor that is not open for writing.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, mode), True)  # the lowest free descriptor
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, closefd=False)
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)


def _use_utf8() -> None:
    """Start again in UTF-8 mode if texts are ASCII: in locale C with that mode switched off.

    Otherwise an argument such as é could not be read, and an output such as ± not be written.
    """
    if sys.getfilesystemencoding() == "ascii":
        os.environ["PYTHONUTF8"] = "1"
        command = [sys.executable, "-X", "utf8", *sys.orig_argv[1:]]
        with suppress(OSError):
            os.execv(sys.executable, command)


@contextmanager
def _loading() -> Iterator[None]:
    """Let a Ctrl-C end the process within the context, unless it is ignored as under `nohup`.

    The garbage collector is off in the context: imports leave no garbage, and searching for it
    takes a tenth of the time.
    """
    gc.disable()
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before)
    gc.freeze()
    gc.enable()


if __name__ == "__main__":
    fishd()
