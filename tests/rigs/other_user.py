"""Commands that run as another user, whose fishds are not those of other tests."""

import os
import subprocess
import sys

import pytest

from rigs.processes import FISHD


def command_as_user(user: int) -> tuple[str, ...]:
    """Return the beginning of a command that runs Python as a user; skip if that is not possible.

    user: number of the user and of its only group
    """
    if os.geteuid() != 0:
        pytest.skip("needs root: a fishd runs as another user")
    become = ("setpriv", f"--reuid={user}", f"--regid={user}", "--clear-groups")
    version = "python{}.{}".format(*sys.version_info)
    for python in (sys.executable, f"/usr/bin/{version}", f"/usr/local/bin/{version}"):
        under = (*become, "env", f"PYTHONPATH={os.pathsep.join(sys.path[1:])}", python)
        child = "import subprocess, sys; sys.exit(subprocess.call([sys.executable, '--version']))"
        for arguments in (["-c", child], [FISHD, "--version"]):
            if subprocess.run([*under, *arguments], capture_output=True, check=False).returncode:
                break
        else:
            return under
    pytest.skip("another user cannot start this fishd: its folder, or Python's, is private")


def spare_user() -> int:
    """Return the number of a user that no other process of tests uses."""
    return 100_000 + os.getpid()
