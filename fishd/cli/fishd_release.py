"""`fishd-release`: what `fishctl release` does, in a fraction of its time.

For that, fishd must have left a recipe. systemd runs it whenever the service has ended, and on a
small Pi each import counts.
"""

import os
import sys
import time
from typing import Any

from fishd import recipe
from fishd.errors import ServoError


def main() -> None:
    """Release the servo as the recipe says; without one, or with other options, as fishctl does."""
    words = sys.argv[1:]
    found = recipe.read(words[1]) if len(words) == 2 and words[0] == "--config" else None
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


def _release(servo: dict[str, Any]) -> int:
    """The exit status; says what was done, in the words of `fishctl release`."""
    ended = os.environ.get("SERVICE_RESULT")
    why = f"the service ended with '{ended}': " if ended else ""
    try:
        done = _neutralise(servo)
    except ServoError as error:
        print(f"fishctl: {error}; {recipe.NOT_RELEASED}", file=sys.stderr)
        return 1
    print(why + ("pulses were on: neutral, then off" if done else "there were no pulses"))
    return 0


def _neutralise(servo: dict[str, Any]) -> bool:
    from types import SimpleNamespace

    if servo["driver"] == "pigpio":
        from fishd.hardware.pigpio_pulses import neutralise

        place = SimpleNamespace(host=servo["host"], port=servo["port"])
        return neutralise(place, servo["gpio"], servo["neutral"], time.sleep)
    from fishd.hardware import pwm_pulses
    from fishd.hardware.pwm_channel import PwmChannel

    sysfs = SimpleNamespace(root=servo["root"], chip=servo["chip"], channel=servo["channel"])
    channel = PwmChannel(SimpleNamespace(gpio=servo["gpio"], sysfs=sysfs), time)
    return pwm_pulses.neutralise(channel, servo["neutral"], 1.0 / servo["frequency"], time.sleep)


if __name__ == "__main__":
    main()
