"""Runs inside the container: writes each change of the virtual Pi's servo pulses, with its time."""

import contextlib
import sys
import time
from pathlib import Path

from fishd.virtual.pi.link import RemotePi

PERIOD = 0.005  # [s]


def main() -> None:
    """Arguments: the socket of the virtual Pi. Ends with the virtual Pi."""
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
