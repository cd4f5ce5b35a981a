"""Prometheus reads the fish at `/metrics`; each metric of the dashboard for Grafana exists."""

import json
import re
import shutil
import signal
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from rigs.documents import ROOT
from rigs.processes import (
    Daemon,
    Process,
    fishctl,
    one_line,
    reserve_port,
    running,
    sets,
    wait_until,
)
from rigs.window_process import (
    NETWORK_HOST,
    Browser,
    WindowProcess,
    open_page,
    running_window,
    wait_until_live,
)

from fishd.control.supervisor import Mode
from fishd.core.signals import ReadingState
from fishd.window.metrics import METRICS, MODES, UNITS, Disk, Scrape, render

DASHBOARD = json.loads((ROOT / "config" / "dashboards" / "fish.json").read_text(encoding="utf-8"))
NAMES = {metric.name: metric.kind for metric in METRICS}
SILENT = "ipc:///nowhere/control"
QUERIES = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]


def need(tool: str) -> str:
    if shutil.which(tool) is None:
        pytest.skip(f"{tool} is not installed: apt install prometheus")
    return tool


def reading(value: float | None, unit: str) -> ReadingState:
    return ReadingState(unit=unit, description="", sensor="s", value=value, age=0.0, problem=None)


def values_of(scrape: str) -> dict[str, float]:
    """Return the value of each series, by the text of its name and labels."""
    lines = (line for line in scrape.splitlines() if not line.startswith("#"))
    return {series: float(value) for series, _, value in (line.rpartition(" ") for line in lines)}


async def read_metrics(browser: Browser, **headers: str) -> tuple[int, str]:
    async with browser.session.get("/metrics", headers=headers) as response:
        return response.status, await response.text()


async def test_a_scrape_shows_what_the_page_is_told(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.swim()
        status = await page.until("status", lambda status: status["mode"] == "running")
        async with browser.session.get("/metrics") as response:
            assert response.headers["Content-Type"].startswith("text/plain; version=0.0.4;")
            values = values_of(await response.text())
    assert values['fishd_up{fish="fish"}'] == 1
    assert {mode: values[f'fishd_mode{{fish="fish",mode="{mode}"}}'] for mode in MODES} == {
        "idle": 0, "running": 1, "fault": 0, "estop": 0,
    }  # fmt: skip
    assert values['fishd_ticks_total{fish="fish"}'] >= status["seq"]
    assert values['fishd_power_watts{fish="fish"}'] > 0
    assert values["fishd_window_disk_size_bytes"] > values["fishd_window_disk_free_bytes"] > 0


def test_each_value_of_a_status_has_its_place(daemon: Daemon) -> None:
    status = daemon.status()
    late = replace(status.timing.lateness, p50=10.0, p99=200.0, max=3000.0)
    status = replace(
        status, mode="fault", thrust=0.1, thrust_ci95=0.02, frequency=1.5, seq=70, missed_slots=3,
        overruns=2, recovered_errors={"bus": 4}, timing=replace(status.timing, lateness=late),
        readings={
            "power": reading(2.5, "W"), "water": reading(19.5, "°C"), "old": reading(None, "°C"),
            'a "b"\\': reading(7.0, "p\nH"),
        },
    )  # fmt: skip
    values = values_of(render(Scrape({"tuna": status}, Disk(size=9, free=4))))
    expected = {
        'up{fish="tuna"}': 1, 'mode{fish="tuna",mode="idle"}': 0,
        'mode{fish="tuna",mode="running"}': 0, 'mode{fish="tuna",mode="fault"}': 1,
        'mode{fish="tuna",mode="estop"}': 0, 'thrust_newtons{fish="tuna"}': 0.1,
        'thrust_ci95_newtons{fish="tuna"}': 0.02, 'frequency_hertz{fish="tuna"}': 1.5,
        'power_watts{fish="tuna"}': 2.5, 'tick_lateness_seconds{fish="tuna",quantile="0.5"}': 1e-5,
        'tick_lateness_seconds{fish="tuna",quantile="0.99"}': 2e-4,
        'tick_lateness_seconds{fish="tuna",quantile="1"}': 3e-3, 'ticks_total{fish="tuna"}': 70,
        'missed_ticks_total{fish="tuna"}': 3, 'overruns_total{fish="tuna"}': 2,
        'recovered_errors_total{fish="tuna",error="bus"}': 4,
        'reading_celsius{fish="tuna",reading="water"}': 19.5,
        r'reading{fish="tuna",reading="a \"b\"\\",unit="p\nH"}': 7, "window_disk_free_bytes": 4,
        "window_disk_size_bytes": 9,
    }  # fmt: skip
    assert values == {f"fishd_{series}": pytest.approx(v) for series, v in expected.items()}


@pytest.mark.parametrize("change", [{"force_unit": "V"}, {"sensor_lost": True}])
def test_a_force_that_is_not_known_in_newtons_is_absent(
    daemon: Daemon, change: dict[str, Any]
) -> None:
    assert "fishd_thrust" in render(Scrape({"fish": daemon.status()}))
    assert "fishd_thrust" not in render(Scrape({"fish": replace(daemon.status(), **change)}))


def test_each_mode_and_each_unit_of_the_drivers_has_a_name() -> None:
    assert list(MODES) == [mode.value for mode in Mode]
    assert len(NAMES) == len(METRICS)
    assert {"°C", "W", "V", "m/s²", "rad/s"} <= UNITS.keys()


async def test_a_silent_fish_has_no_old_values(own_daemon: Daemon, tmp_path: Path) -> None:
    fish = {"fish": own_daemon.endpoint, "gone": SILENT}
    with running_window(tmp_path, **fish) as window:
        await wait_until_live(window)
        async with Browser(window.url) as browser, open_page(browser) as page:
            _, scrape = await read_metrics(browser)
            assert re.findall('.*"gone".*', scrape) == ['fishd_up{fish="gone"} 0.0']
            assert values_of(scrape)['fishd_up{fish="fish"}'] == 1
            own_daemon.kill()
            await page.until("connection", lambda connection: connection["state"] != "live")
            _, scrape = await read_metrics(browser)
            assert re.findall('.*"fish".*', scrape) == ['fishd_up{fish="fish"} 0.0']


async def test_a_disk_that_does_not_answer_keeps_no_scrape_and_no_end_waiting(
    daemon: Daemon, tmp_path: Path
) -> None:
    stalled = "import shutil, time; shutil.disk_usage = lambda path: time.sleep(1e6)"
    with running_window(tmp_path, changes=stalled, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            for _ in range(2):
                status, scrape = await read_metrics(browser)
                assert (status, "disk" in scrape) == (200, False)
        assert window.end(signal.SIGINT)[0] == 0


async def test_from_the_network_a_scrape_needs_a_token_which_opens_nothing_else(
    window: WindowProcess,
) -> None:
    token = window.ask("token", "prometheus").strip()
    bearer = {"Authorization": f"Bearer {token}"}
    async with Browser(window.url, NETWORK_HOST) as browser:
        while (await read_metrics(browser, **bearer))[0] != 200:
            pass  # the window has not read the file of devices yet
        for wrong in ("", token, f"Basic {token}", f"Bearer {token}x", "Bearer", "Bearer " * 200):
            status, refusal = await read_metrics(browser, Authorization=wrong)
            assert (status, "fishctl window token NAME" in refusal) == (401, True)
        for path in ("/api/fish", "/api/jobs", "/api/runs", "/live"):
            assert await browser.refusal(path, headers=bearer) == (401, "not-paired")
        refused = await browser.refusal("/api/fish/fish/estop", {}, headers=bearer)
        assert refused == (401, "not-paired")
        assert "watch  seen" in window.ask("devices")
        window.ask("revoke", "prometheus")
        while (await read_metrics(browser, **bearer))[0] != 401:
            pass


def test_a_token_is_printed_for_programs_too(tmp_path: Path) -> None:
    state = ("--state", str(tmp_path))
    named = [json.loads(fishctl("window", "token", *state, "--json", "p").stdout) for _ in "ab"]
    assert [token["name"] for token in named] == ["p", "p 2"]
    assert named[0]["token"] not in (tmp_path / "devices.json").read_text()
    tmp_path.chmod(0o777)
    assert "chmod go-w" in one_line(fishctl("window", "token", *state, "p"))


def test_the_metrics_are_as_prometheus_wants_them(daemon: Daemon) -> None:
    status = replace(
        daemon.status(), recovered_errors={"bus": 1},
        readings={f"r{n}": reading(1.0, unit) for n, unit in enumerate([*UNITS, "pH"])}
        | {"power": reading(1.0, "W")},
        thrust_ci95=0.1,
    )  # fmt: skip
    scrape = render(Scrape({"a": status, "b": status, "c": None}, Disk(2, 1)))
    assert all(f"# TYPE {name} {kind}\n" in scrape for name, kind in NAMES.items())
    done = subprocess.run(
        [need("promtool"), "check", "metrics"], input=scrape, text=True, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_each_metric_of_dashboard_and_page_exists_and_only_counters_have_rates() -> None:
    page = (ROOT / "docs" / "how-to" / "window.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\bfishd_\w+", page)) <= NAMES.keys()
    texts = [*QUERIES, *(v["query"]["query"] for v in DASHBOARD["templating"]["list"][1:])]
    names = {name for query in texts for name in re.findall(r"(?<!\")\bfishd_\w+", query)}
    assert names <= NAMES.keys()
    patterns = {pattern for query in texts for pattern in re.findall(r'__name__=~"(.+?)"', query)}
    shown = {name for name in NAMES if any(re.fullmatch(p, name) for p in patterns)}
    assert all(any(re.fullmatch(p, name) for name in NAMES) for p in patterns)
    assert names | shown == NAMES.keys()  # and nothing is left out
    rates = re.findall(r"(rate|increase)?\(?(fishd_\w+)", " ".join(QUERIES))
    assert all(bool(rate) == (NAMES[n] == "counter") for rate, n in rates if n in NAMES)


def test_no_panel_of_the_dashboard_covers_another_one() -> None:
    cells = [cell for panel in DASHBOARD["panels"] for cell in cells_of(panel["gridPos"])]
    assert len(cells) == len(set(cells))
    assert max(x for x, _ in cells) < 24
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


def cells_of(place: dict[str, int]) -> Iterator[tuple[int, int]]:
    for x in range(place["x"], place["x"] + place["w"]):
        for y in range(place["y"], place["y"] + place["h"]):
            yield x, y


def test_a_real_prometheus_scrapes_it_and_answers_the_dashboard(tmp_path: Path) -> None:
    prometheus = need("prometheus")
    with (
        running(tmp_path, *sets("sensors.water.kind=simulated")) as daemon,
        running_window(tmp_path, settings="pair_all: true", fish=daemon.endpoint) as window,
        reserve_port() as reserved,
    ):
        (tmp_path / "token").write_text(window.ask("token", "prometheus"))
        (tmp_path / "prometheus.yml").write_text(
            f"""
scrape_configs:
  - job_name: fishd
    scrape_interval: 500ms
    scrape_timeout: 500ms
    authorization: {{credentials_file: {tmp_path}/token}}
    static_configs: [{{targets: ["127.0.0.1:{window.port}"]}}]
"""
        )
        port = reserved.getsockname()[1]
        with Process(
            prometheus, f"--config.file={tmp_path}/prometheus.yml",
            f"--storage.tsdb.path={tmp_path}/db", f"--web.listen-address=127.0.0.1:{port}",
        ):  # fmt: skip

            def ask(query: str) -> Any:
                address = f"http://127.0.0.1:{port}/api/v1/query?"
                try:
                    with urllib.request.urlopen(
                        address + urllib.parse.urlencode({"query": query})
                    ) as answer:
                        return json.load(answer)["data"]["result"]
                except OSError:  # it starts
                    return []

            for query in QUERIES:
                written = query.replace("$fish", "fish").replace("$__rate_interval", "1m")
                wait_until(partial(ask, written))
