"""Where fishd keeps what lasts as long as it runs; needs nothing but the standard library."""

import os


def runtime_folder() -> str:
    """systemd's folder, else the login session's, else one under /tmp; it need not exist."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    if runtime:
        return runtime
    session = os.environ.get("XDG_RUNTIME_DIR")
    if session and os.path.isdir(session):
        return f"{session}/fishd"
    return f"/tmp/fishd-{os.getuid()}"
