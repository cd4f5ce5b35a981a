"""`fishd-release`: what `fishctl release` does, in a fraction of its time.

It needs the recipe that fishd wrote. systemd runs it whenever the service has ended, and on a
small Pi each import takes time.
"""

import os
import signal
import sys
from contextlib import suppress
from typing import Any

from fishd.core.errors import ServoError, StartupError
from fishd.hardware import release_recipe


def main() -> None:
    """Release the servo by the recipe; without one, or with other options, as fishctl does.

    Neither a lost session nor Ctrl-C ends it halfway while pulses go on.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    arguments = sys.argv[1:]
    recipe = (
        release_recipe.read(arguments[1])
        if len(arguments) == 2 and arguments[0] == "--config"
        else None
    )
    status = _release(recipe) if recipe else 0
    if recipe and recipe["fresh"]:
        sys.exit(status)
    # The file has changed since that fishd started, and may name another servo: release both.
    from fishd.cli.main import main as fishctl

    sys.argv[:] = ["fishctl", "release", *arguments]
    try:
        fishctl()
    except SystemExit as end:
        sys.exit(end.code or status)
    sys.exit(status)


def _release(recipe: dict[str, Any]) -> int:
    """Release the servo, print what was done as `fishctl release` does; return the exit status."""
    service_result = os.environ.get("SERVICE_RESULT")
    prefix = f"the service ended with '{service_result}': " if service_result else ""
    try:
        done = release_recipe.carry_out(recipe["function"], recipe["neutral"], recipe["arguments"])
    except (ServoError, StartupError, ImportError) as error:
        with suppress(OSError):  # the terminal may be gone
            print(f"fishctl: {error}; {release_recipe.NOT_RELEASED}", file=sys.stderr)
        return 1
    with suppress(OSError):
        print(prefix + release_recipe.describe_outcome(done))
    return 0


if __name__ == "__main__":
    main()
