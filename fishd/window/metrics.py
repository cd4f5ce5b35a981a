"""The fish in Prometheus' text format, at `/metrics`; `METRICS` has each name, type and help.

A scrape shows what the window has received already; between scrapes, nothing here runs.
"""

import asyncio
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, NamedTuple

from aiohttp import web

from fishd.core.signals import Status
from fishd.window.access import AccessControl
from fishd.window.fish_link import FishLink

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
DISK_TIMEOUT_S = 0.5
"""Longest wait of a scrape for the disk of the runs [s]."""
MODES = "idle", "running", "fault", "estop"
UNITS = {
    "A": "amperes", "Hz": "hertz", "N": "newtons", "Pa": "pascals", "V": "volts", "W": "watts",
    "m": "meters", "m/s": "meters_per_second", "m/s²": "meters_per_second_squared",
    "rad": "radians", "rad/s": "radians_per_second", "s": "seconds", "°C": "celsius",
}  # fmt: skip
"""Units of readings, as Prometheus writes them at the end of a name."""
_ESCAPES = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})

Values = Iterable[tuple[dict[str, str], float | None]]
"""Labels and values; a value that is None is left out."""


class Disk(NamedTuple):
    """Size and free space of a disk [bytes]."""

    size: int
    free: int


class Scrape(NamedTuple):
    """Content of an answer to Prometheus."""

    fish: Mapping[str, Status | None]
    """Status of each fish by its name; None while the window does not hear it."""
    disk: Disk | None = None
    """Disk of the runs; None if it does not answer."""


class Metric(NamedTuple):
    """A metric, with the function that returns its values."""

    name: str
    kind: Literal["counter", "gauge", "summary"]
    help: str
    read: Callable[[Scrape], Values]

    def render(self, scrape: Scrape) -> str:
        """Return the metric in Prometheus' text format; empty without values."""
        lines = [f"# HELP {self.name} {self.help}", f"# TYPE {self.name} {self.kind}"]
        for labels, value in self.read(scrape):
            if value is not None:
                pairs = ",".join(f'{key}="{v.translate(_ESCAPES)}"' for key, v in labels.items())
                lines.append(f"{self.name}{f'{{{pairs}}}' * bool(pairs)} {float(value)!r}")
        return "\n".join([*lines, ""]) if len(lines) > 2 else ""


def _values(read: Callable[[Status], Values]) -> Callable[[Scrape], Values]:
    """Return the function that reads a metric of each fish which the window hears."""
    return lambda scrape: [
        ({"fish": name, **labels}, value)
        for name, status in scrape.fish.items()
        if status
        for labels, value in read(status)
    ]


def _value(read: Callable[[Status], float | None]) -> Callable[[Scrape], Values]:
    """Return the function that reads a metric with one value for each fish."""
    return _values(lambda status: [({}, read(status))])


def _force(read: Callable[[Status], float | None]) -> Callable[[Scrape], Values]:
    """Return the function that reads a force, without an old one and one of another unit."""
    return _value(
        lambda status: None if status.sensor_lost or status.force_unit != "N" else read(status)
    )


def _power(status: Status) -> float | None:
    reading = status.readings.get("power")
    return reading.value if reading and reading.unit == "W" else None


def _lateness(status: Status) -> Values:
    lateness = status.timing.lateness
    quantiles = {"0.5": lateness.p50, "0.99": lateness.p99, "1": lateness.max}
    return [({"quantile": quantile}, 1e-6 * value) for quantile, value in quantiles.items()]


def _readings(unit: str) -> Callable[[Scrape], Values]:
    """Return the function that reads the readings in a unit, without the power of the servo."""
    return _values(
        lambda status: [
            ({"reading": name}, reading.value)
            for name, reading in status.readings.items()
            if reading.unit == unit and (name, unit) != ("power", "W")
        ]
    )


METRICS = (
    Metric(
        "fishd_up",
        "gauge",
        "1 while ticks of the fish arrive, else 0: it then has no other metrics.",
        lambda scrape: [({"fish": name}, bool(status)) for name, status in scrape.fish.items()],
    ),
    Metric(
        "fishd_mode",
        "gauge",
        "1 for the mode of the fish, 0 for the others.",
        _values(lambda status: [({"mode": mode}, mode == status.mode) for mode in MODES]),
    ),
    Metric(
        "fishd_thrust_newtons",
        "gauge",
        "Mean thrust over the latest whole tail beats; absent without a calibrated force sensor.",
        _force(lambda status: status.thrust),
    ),
    Metric(
        "fishd_thrust_ci95_newtons",
        "gauge",
        "Half-width of the 95 % confidence interval of the thrust; absent while unknown.",
        _force(lambda status: status.thrust_ci95),
    ),
    Metric(
        "fishd_frequency_hertz",
        "gauge",
        "Tail-beat frequency; 0 without beats.",
        _value(lambda status: status.frequency),
    ),
    Metric(
        "fishd_power_watts",
        "gauge",
        "Electrical power that the servo takes; absent without a power meter.",
        _value(_power),
    ),
    Metric(
        "fishd_tick_lateness_seconds",
        "summary",
        "Delay of the start of a tick after its deadline, since fishd started; "
        "the quantile 1 is the maximum.",
        _values(_lateness),
    ),
    Metric(
        "fishd_ticks_total",
        "counter",
        "Ticks since fishd started.",
        _value(lambda status: status.seq),
    ),
    Metric(
        "fishd_missed_ticks_total",
        "counter",
        "Ticks that were skipped since fishd started.",
        _value(lambda status: status.missed_slots),
    ),
    Metric(
        "fishd_overruns_total",
        "counter",
        "Ticks that took longer than a period since fishd started.",
        _value(lambda status: status.overruns),
    ),
    Metric(
        "fishd_recovered_errors_total",
        "counter",
        "Errors that fishd recovered from since it started, by name.",
        _values(
            lambda status: [
                ({"error": name}, count) for name, count in status.recovered_errors.items()
            ]
        ),
    ),
    *(
        Metric(
            f"fishd_reading_{name}",
            "gauge",
            f"Readings of sensors in {name.replace('_', ' ')}, without old ones.",
            _readings(unit),
        )
        for unit, name in UNITS.items()
    ),
    Metric(
        "fishd_reading",
        "gauge",
        "Readings of sensors in any other unit, which is a label.",
        _values(
            lambda status: [
                ({"reading": name, "unit": reading.unit}, reading.value)
                for name, reading in status.readings.items()
                if reading.unit not in UNITS
            ]
        ),
    ),
    Metric(
        "fishd_window_disk_free_bytes",
        "gauge",
        "Free space of the disk with the window's folder of runs.",
        lambda scrape: [({}, scrape.disk and scrape.disk.free)],
    ),
    Metric(
        "fishd_window_disk_size_bytes",
        "gauge",
        "Size of that disk.",
        lambda scrape: [({}, scrape.disk and scrape.disk.size)],
    ),
)


def render(scrape: Scrape) -> str:
    """Return all metrics that have values, in Prometheus' text format."""
    return "".join(metric.render(scrape) for metric in METRICS)


class MetricsRequests:
    """The request of Prometheus for the metrics of all fish."""

    def __init__(self, access: AccessControl, links: Mapping[str, FishLink], runs: Path) -> None:
        """runs: folder whose disk is shown"""
        self._access, self._links, self._runs = access, links, runs
        # A disk may stall: one thread waits for it, and no request does so for long.
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="metrics")
        self._reading: asyncio.Future[Disk | None] | None = None
        self.routes = [web.get("/metrics", self._serve)]

    async def _serve(self, request: web.Request) -> web.Response:
        self._access.require(request, "watch", takes_bearer=True)
        fish = {name: link.status if link.is_heard else None for name, link in self._links.items()}
        body = render(Scrape(fish, await self._read_disk()))
        return web.Response(body=body.encode(), headers={"Content-Type": CONTENT_TYPE})

    async def _read_disk(self) -> Disk | None:
        """Return the disk of the runs; None if it does not answer in time."""
        if self._reading is None or self._reading.done():
            loop = asyncio.get_running_loop()
            self._reading = loop.run_in_executor(self._disk, measure_disk, self._runs)
        done, _ = await asyncio.wait([self._reading], timeout=DISK_TIMEOUT_S)
        return next(iter(done)).result() if done else None


def measure_disk(folder: Path) -> Disk | None:
    """Return the disk of a folder, which may not exist yet; None if it cannot be read."""
    try:
        usage = shutil.disk_usage(next(p for p in (folder, *folder.parents) if p.exists()))
    except OSError:
        return None
    return Disk(usage.total, usage.free)
