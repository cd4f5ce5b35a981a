"""Where the commands begin: a Ctrl-C while they are still being loaded ends them quietly."""

from fishd.core import safe_path

safe_path.leave_working_directory_out()
try:
    import gc
    import signal
    from collections.abc import Iterator
    from contextlib import contextmanager
except KeyboardInterrupt:
    raise SystemExit(130) from None


def fishd() -> None:
    """The `fishd` command."""
    with _loading():
        from fishd.daemon.main import main
    main()


def fishctl() -> None:
    """The `fishctl` command."""
    with _loading():
        from fishd.cli.main import main
    main()


def fishd_camera() -> None:
    """The `fishd-camera` command."""
    with _loading():
        from fishd.camera.main import main
    main()


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
