"""Program in the container that writes the changes of the virtual Pi's servo pulses."""

import contextlib
import sys
import time
from pathlib import Path

from fishd.virtual.pi.link import RemotePi

PERIOD = 0.005
"""Time between two checks of the pulses [s]."""


def main() -> None:
    """Watch until the virtual Pi ends; argument of the command: socket of the virtual Pi."""
    last = -1.0
    with contextlib.suppress(OSError), RemotePi(Path(sys.argv[1])) as pi:
        while True:
            pulse = pi.state().pulse
            if pulse != last:
                print(f"{time.monotonic():.6f} {pulse:.1f}", flush=True)
                last = pulse
            time.sleep(PERIOD)


if __name__ == "__main__":
    main()
