"""Folder of fishd's files that exist only while it runs; uses only the standard library."""

import os


def runtime_folder() -> str:
    """Return systemd's folder, else that of the login session, else one in /tmp; may not exist."""
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    if runtime:
        return runtime
    session = os.environ.get("XDG_RUNTIME_DIR")
    if session and os.path.isdir(session):
        return f"{session}/fishd"
    return f"/tmp/fishd-{os.getuid()}"
