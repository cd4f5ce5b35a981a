"""`fishd-release`: what `fishctl release` does, in a fraction of its time.

For that, fishd must have left a recipe. systemd runs it whenever the service has ended, and on a
small Pi each import counts.
"""

import os
import signal
import sys
from contextlib import suppress
from typing import Any

from fishd.core.errors import ServoError, StartupError
from fishd.hardware import release_recipe


def main() -> None:
    """Release the servo as the recipe says; without one, or with other options, as fishctl does.

    Neither a lost session nor Ctrl-C ends it halfway, with pulses that go on.
    """
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)
    words = sys.argv[1:]
    found = release_recipe.read(words[1]) if len(words) == 2 and words[0] == "--config" else None
    status = _release(found) if found else 0
    if found and found["fresh"]:
        sys.exit(status)
    # The file has changed since that fishd began, and may mean another servo: that one as well.
    from fishd.cli.main import main as fishctl

    sys.argv[:] = ["fishctl", "release", *words]
    try:
        fishctl()
    except SystemExit as end:
        sys.exit(end.code or status)
    sys.exit(status)


def _release(recipe: dict[str, Any]) -> int:
    """The exit status; says what was done, in the words of `fishctl release`."""
    ended = os.environ.get("SERVICE_RESULT")
    why = f"the service ended with '{ended}': " if ended else ""
    try:
        done = release_recipe.carry_out(recipe["function"], recipe["neutral"], recipe["arguments"])
    except (ServoError, StartupError, ImportError) as error:
        with suppress(OSError):  # the terminal may be gone
            print(f"fishctl: {error}; {release_recipe.NOT_RELEASED}", file=sys.stderr)
        return 1
    with suppress(OSError):
        print(why + release_recipe.outcome(done))
    return 0


if __name__ == "__main__":
    main()
