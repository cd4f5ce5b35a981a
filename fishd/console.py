"""One line a second for whoever runs `fishd` in a terminal."""

from fishd.signals import Status


def status_line(status: Status) -> str:
    """Mode, controller, frequency, mean thrust, lateness and missed ticks."""
    what = status.mode if status.mode == "idle" else f"{status.mode} {status.controller}"
    if status.reason:
        what = f"{status.mode} {status.reason.code}"
    return (
        f"{what:<16} {status.frequency:5.2f} Hz  thrust {status.thrust * 1e3:6.2f} mN  "
        f"late p50 {status.timing.lateness.p50:4.0f} p99 {status.timing.lateness.p99:4.0f} µs  "
        f"missed {status.missed} of {status.seq + status.missed} ticks"
    )
