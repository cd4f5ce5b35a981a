"""Where the commands begin: a Ctrl-C while they are still being loaded ends them quietly."""

import os
import sys


def _leave_working_directory_out() -> None:
    """Import nothing from the working directory from now on, in this process or its children.

    `python -m fishd` puts that folder first; what Python itself loads before, such as `runpy`, only
    `python -P -m fishd` protects. A folder that PYTHONPATH names stays.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        folder = os.getcwd()  # noqa: PTH109 (pathlib is not loaded yet)
    except OSError:  # it was deleted
        folder = ""
    if not sys.flags.safe_path and sys.path and sys.path[0] in ("", folder):
        del sys.path[0]


_leave_working_directory_out()
try:
    import gc
    import signal
    from collections.abc import Iterator
    from contextlib import contextmanager, suppress
except KeyboardInterrupt:
    raise SystemExit(130) from None


def fishd() -> None:
    """The `fishd` command."""
    _prepare()
    with _loading():
        from fishd.daemon.main import main
    main()


def fishctl() -> None:
    """The `fishctl` command."""
    _prepare()
    with _loading():
        from fishd.cli.main import main
    main()


def fishd_camera() -> None:
    """The `fishd-camera` command."""
    _prepare()
    with _loading():
        from fishd.camera.main import main
    main()


def _prepare() -> None:
    """Make up for odd conditions in which a command was started."""
    _open_closed_streams()
    _use_utf8()


def _open_closed_streams() -> None:
    """Open standard streams that were closed, so that no other file gets their descriptors.

    Writing to standard output fails then as on any descriptor that is not open for it.
    """
    for number, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, mode), True)  # takes the lowest that is free
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, closefd=False)
    if sys.stdout is None:
        sys.stdout = os.fdopen(1, "w", closefd=False)
    if sys.stderr is None:
        sys.stderr = os.fdopen(2, "w", closefd=False)


def _use_utf8() -> None:
    """Start again in UTF-8 mode where texts are ASCII: locale C with that mode switched off.

    Neither an option such as é nor an output such as ± could be read or written.
    """
    if sys.getfilesystemencoding() == "ascii":
        os.environ["PYTHONUTF8"] = "1"
        command = [sys.executable, "-X", "utf8", *sys.orig_argv[1:]]
        with suppress(OSError):
            os.execv(sys.executable, command)


@contextmanager
def _loading() -> Iterator[None]:
    """Let a Ctrl-C meanwhile be the end of the process, unless it is ignored as below `nohup`.

    Nothing that is loaded is garbage: to look for it takes a tenth of the time.
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
