"""`cyclictest` of the package rt-tests: how late a bare program wakes up on this machine."""

MAX_HISTOGRAM_US = 100_000
"""Range of the histogram [µs]; later wake-ups count as this."""


def command(period: float, seconds: float, priority: int) -> list[str]:
    """Return the command; period: time between two wake-ups [s]; priority: 0 is the normal one."""
    policy = [f"--priority={priority}"] if priority else ["--policy=other"]
    # Without --laptop, cyclictest keeps the CPUs out of deep sleep, for every other program, too.
    words = ["cyclictest", "--quiet", "--mlockall", "--laptop", *policy]
    words += [f"--interval={period * 1e6:.0f}", f"--histogram={MAX_HISTOGRAM_US}"]
    return [*words, f"--duration={max(1, seconds):.0f}"]


def parse(output: str) -> tuple[list[float], float]:
    """Return the lateness of each wake-up [s], and the largest one [µs]."""
    late: list[float] = []
    worst = 0.0
    for line in output.splitlines():
        words = line.split()
        if line.startswith("# Max Latencies:"):
            worst = float(words[-1])
        elif line.startswith("# Histogram Overflows:"):
            late += [MAX_HISTOGRAM_US * 1e-6] * int(words[-1])
        elif len(words) == 2 and words[0].isdigit() and int(words[1]):
            late += [int(words[0]) * 1e-6] * int(words[1])
    return late, worst
