"""Folder of fishd's files that exist only while it runs; uses only the standard library."""

import os
from collections.abc import Mapping


def runtime_folder(environment: Mapping[str, str] = os.environ) -> str:
    """Return systemd's folder, else that of the login session, else one in /tmp; may not exist.

    environment: that of a process of this user
    """
    runtime = environment.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    if runtime:
        return runtime
    session = environment.get("XDG_RUNTIME_DIR")
    if session and os.path.isdir(session):
        return f"{session}/fishd"
    return f"/tmp/fishd-{os.getuid()}"
