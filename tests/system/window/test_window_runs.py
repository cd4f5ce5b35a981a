"""Runs of the page: notes, names, the trash, results and downloads, and rights to them."""

import asyncio
import csv
import io
import json
import os
import shutil
import signal
import zipfile
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest
from rigs.processes import Daemon
from rigs.recordings import record_run, swum
from rigs.window_attacks import Target, press
from rigs.window_process import NETWORK_HOST, Browser, WindowProcess, open_page, running_window

from common.daemon import list_children
from fishd.core.process.lockfile import locked
from fishd.lab.experiment import Header, open_experiment
from fishd.recording import open_run
from fishd.window.downloads import ENDINGS, MAX_DOWNLOADS_PER_DEVICE

BIG_BYTES = 150 * 2**20
SECRET = b"a file of another program"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(swum(1.0), tmp_path_factory.mktemp("recorded") / "first")


@pytest.fixture
def runs(window: WindowProcess, recorded: Path) -> Iterator[Path]:
    """Fill the folder of runs with the recording `first` and the experiment `swept`."""
    folder = window.state.parent / "runs"
    yield fill(folder, recorded)
    shutil.rmtree(folder)


def fill(folder: Path, recorded: Path) -> Path:
    folder.mkdir(exist_ok=True)
    shutil.copy(recorded, folder / "first.mcap")
    with open_experiment(folder / "swept", Header(kind="sweep", on="simulation")) as experiment:
        experiment.open_table(["frequency", "thrust"]).add({"frequency": 1.5, "thrust": 0.02})
    return folder


def write_big(path: Path) -> None:
    """Write a large file, which takes no space on the disk."""
    with path.open("wb") as file:
        file.truncate(BIG_BYTES)


async def names_of(browser: Browser) -> set[str]:
    return {run["name"] for run in await browser.get("/api/runs")}


async def test_a_run_is_noted_renamed_deleted_and_brought_back(
    window: WindowProcess, runs: Path
) -> None:
    async with Browser(window.url) as browser:
        await browser.post("/api/runs/first.mcap/note", {"note": "-x; $(y) größer"})
        (path,) = await browser.post("/api/runs/first.mcap/rename", {"name": "better"})
        assert path == str(runs / "better.mcap")
        listed = {run["name"]: run for run in await browser.get("/api/runs")}
        assert listed["better"]["about"]["note"] == "-x; $(y) größer"
        (deleted,) = await browser.post("/api/runs/swept/delete")
        assert await names_of(browser) == {"better"}
        assert await browser.get("/api/trash") == [deleted]
        await browser.post(f"/api/trash/{deleted['id']}/restore")
        assert await names_of(browser) == {"better", "swept"}
        assert await browser.get("/api/trash") == []


async def test_the_trash_is_emptied(window: WindowProcess, runs: Path) -> None:
    async with Browser(window.url) as browser:
        for name in ("first.mcap", "swept"):
            await browser.post(f"/api/runs/{name}/delete")
        second, first = await browser.get("/api/trash")  # another device deletes the second later
        assert await browser.post("/api/trash/empty", {"ids": [first["id"]]}) == [second]
        assert await browser.refusal("/api/trash/empty", {"ids": []}) == (400, "bad-arguments")
        assert await browser.post("/api/trash/empty", {"ids": [second["id"], "gone"]}) == []
        assert list(runs.rglob("*.mcap")) == []


async def test_a_live_run_has_the_name_of_its_fish_though_fishd_knows_none(
    daemon: Daemon, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    for number, endpoint in enumerate((daemon.endpoint, "ipc:///elsewhere")):
        command = ["swing", "--endpoint", endpoint]
        header = Header(kind="measure", on="live", command=command, number=number)
        with open_experiment(runs / f"measured {number}", header):
            pass
    with running_window(tmp_path, tuna=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            listed = {run["name"]: run["about"] for run in await browser.get("/api/runs")}
            assert listed == {"measured 0": {"subject": "tuna"}, "measured 1": {}}
            body = {"fish": "tuna", "kind": "record", "options": {"seconds": 1}}
            checked = await browser.post("/api/jobs/check", body)
            assert " ".join(checked["command"]) == "fishctl record --subject tuna --for 1"


async def test_a_run_in_progress_or_a_name_that_exists_is_a_line(
    window: WindowProcess, runs: Path
) -> None:
    async with Browser(window.url) as browser:

        async def message(path: str, body: dict[str, str]) -> str:
            async with browser.session.post(path, json=body) as response:
                assert response.status == 409
                return str((await response.json())["error"]["message"])

        with locked(runs / "swept" / "experiment"):
            for what, body in (("delete", {}), ("rename", {"name": "other"})):
                said = await message(f"/api/runs/swept/{what}", body)
                assert said == "swept is in progress; stop it, or wait for its end"
        said = await message("/api/runs/swept/rename", {"name": "first"})
        assert said == f"{runs / 'first.mcap'} exists already; choose another name"
        assert await names_of(browser) == {"first", "swept"}


async def test_results_are_compared_as_a_table_and_as_a_picture(
    window: WindowProcess, runs: Path, recorded: Path
) -> None:
    shutil.copy(recorded, runs / "second.mcap")
    query = "run=first.mcap&run=second.mcap"
    async with Browser(window.url) as browser:
        first, second = await browser.get(f"/api/results?{query}")
        assert (first["name"], second["name"]) == ("first", "second")
        assert first["rows"][0]["values"]["thrust"][0] == open_run(recorded).summary.thrust
        (swept,) = await browser.get("/api/results?run=swept")
        assert swept["columns"] == {"frequency": [1.5], "thrust": [0.02]}
        async with browser.session.get(f"/api/results.png?{query}") as response:
            assert (response.status, response.content_type) == (200, "image/png")
            assert (await response.read()).startswith(b"\x89PNG")
        for wrong in ("", "&".join(f"run={number}" for number in range(13))):
            refused = await browser.refusal(f"/api/results?{wrong}")
            assert refused == (400, "bad-arguments")


async def test_a_download_is_what_the_exporters_write(
    window: WindowProcess, runs: Path, recorded: Path
) -> None:
    async with Browser(window.url) as browser:

        async def download(run: str, file: str) -> bytes:
            async with browser.session.get(f"/api/runs/{run}/download/{file}") as response:
                assert response.status == 200
                name = run.removesuffix(".mcap") + ENDINGS[file]
                assert response.headers["Content-Disposition"].endswith(f"''{name}")
                return await response.read()

        assert await download("first.mcap", "recording.mcap") == recorded.read_bytes()
        ticks = list(
            csv.DictReader(io.StringIO((await download("first.mcap", "ticks.csv")).decode()))
        )
        assert [float(row["fx"]) for row in ticks] == [tick.fx for tick in open_run(recorded).ticks]
        assert b"controller" in await download("first.mcap", "events.csv")
        assert (await download("first.mcap", "ticks.parquet")).startswith(b"PAR1")
        assert await download("swept", "rows.csv") == (runs / "swept" / "rows.csv").read_bytes()
        for run in ("first.mcap", "swept"):
            with zipfile.ZipFile(io.BytesIO(await download(run, "all.zip"))) as archive:
                assert archive.testzip() is None
                assert len(archive.namelist()) == (1 if run == "first.mcap" else 2)
    assert not [path for path in window.state.rglob("*") if path.name.startswith("tmp")]


CHANGES = {
    "/api/runs/first.mcap/note": {"note": "x"},
    "/api/runs/first.mcap/rename": {"name": "x"},
    "/api/runs/first.mcap/delete": {},
    "/api/trash/20260101-000000/restore": {},
    "/api/trash/empty": {"ids": ["x"]},
}
READS = (
    "/api/trash", "/api/results?run=first.mcap", "/api/results.png?run=first.mcap",
    *(f"/api/runs/first.mcap/download/{file}" for file in ENDINGS),
)  # fmt: skip


async def test_a_device_that_may_watch_downloads_and_changes_nothing(
    window: WindowProcess, runs: Path
) -> None:
    async with Browser(window.url, NETWORK_HOST) as browser:
        for path, body in CHANGES.items():
            assert await browser.refusal(path, body) == (401, "not-paired")
        for path in READS:
            assert await browser.refusal(path) == (401, "not-paired")
        token = window.invite("watch").rpartition("=")[2]
        await browser.post("/api/pair", {"token": token, "name": "wall"})
        for path, body in CHANGES.items():
            assert await browser.refusal(path, body) == (403, "only-watch")
        for path in READS:
            async with browser.session.get(path) as response:
                assert response.status == (409 if "rows.csv" in path else 200), path
                await response.read()
        assert await names_of(browser) == {"first", "swept"}


HOSTILE = [
    "..", "..%2f..%2fsecret", "%2fetc%2fpasswd", ".trash", "-x", "--forever", "~root", "a%00b",
    "a%0ab", "a" * 300, "linked.mcap", "linked", "outside%2fsecret", "none", "pipe.mcap", "latest",
]  # fmt: skip
"""Names that are not those of a run, as an address has them."""


@pytest.mark.parametrize("name", HOSTILE)
async def test_no_name_leads_out_of_the_folder_of_runs(
    window: WindowProcess, runs: Path, name: str
) -> None:
    secret = runs.parent / "secret"
    secret.mkdir(exist_ok=True)
    for file in ("experiment.json", "rows.csv", "note.txt"):
        (secret / file).write_bytes(SECRET)
    (runs / "linked.mcap").symlink_to(secret / "rows.csv")
    (runs / "linked").symlink_to(secret)
    os.mkfifo(runs / "pipe.mcap")
    before = sorted(runs.parent.rglob("*"))
    refusals = {(409, "job"), (404, "not-found"), (405, "method-not-allowed"), (403, "forbidden")}
    async with Browser(window.url) as browser:
        for what, body in (("note", {"note": "x"}), ("rename", {"name": "y"}), ("delete", {})):
            assert await browser.refusal(f"/api/runs/{name}/{what}", body) in refusals
        for path in (
            *(f"/api/runs/{name}/download/{file}" for file in ENDINGS), f"/api/results?run={name}",
            f"/api/results.png?run={name}",
        ):  # fmt: skip
            async with browser.session.get(path) as response:
                body = await response.read()
                assert (response.status, json.loads(body)["error"]["code"]) in refusals, path
                assert SECRET not in body
        assert await browser.refusal(f"/api/trash/{name}/restore", {}) in refusals
    assert sorted(path for path in runs.parent.rglob("*") if path in before) == before
    assert (secret / "note.txt").read_bytes() == SECRET


@pytest.mark.parametrize(
    ("what", "body"),
    [
        ("note", {"note": "x" * 1001}), ("note", {"note": "a\nb"}), ("note", {"text": "x"}),
        ("note", {"note": 3}), ("rename", {"name": "x" * 101}), ("rename", {}),
        ("delete", {"forever": True}), ("delete", []),
    ],
)  # fmt: skip
async def test_a_wrong_body_is_refused(
    window: WindowProcess, runs: Path, what: str, body: object
) -> None:
    async with Browser(window.url) as browser:
        refused = await browser.refusal(f"/api/runs/first.mcap/{what}", body)
        assert refused == (400, "bad-arguments")
        refused = await browser.refusal("/api/runs/first.mcap/download/secret.txt")
        assert refused == (404, "not-found")
        assert await names_of(browser) == {"first", "swept"}


@asynccontextmanager
async def unread(window: WindowProcess, path: str) -> AsyncIterator[asyncio.StreamReader]:
    """Begin a download, and read no more than its head."""
    target = Target("127.0.0.1", window.port)
    reader, writer = await target.connect()
    try:
        writer.write(target.request("GET", path))
        assert (await reader.readuntil(b"\r\n")).startswith(b"HTTP/1.1 200")
        yield reader
    finally:
        writer.transport.abort()


BIG = "/api/runs/big.mcap/download/recording.mcap"


async def test_few_downloads_are_sent_at_a_time_and_none_delays_an_emergency_stop(
    window: WindowProcess, runs: Path, daemon: Daemon
) -> None:
    write_big(runs / "big.mcap")
    async with Browser(window.url) as browser:
        async with unread(window, BIG), unread(window, BIG):
            assert MAX_DOWNLOADS_PER_DEVICE == 2
            for _ in range(50):
                assert await browser.refusal(BIG) == (503, "busy")
            assert await names_of(browser) >= {"first", "swept"}
            assert await press(Target("127.0.0.1", window.port)) is not None
        await wait_for_place(browser)
        assert daemon.status().mode == "estop"
        async with open_page(browser) as page:
            await page.drive()
            await page.request("clear-fault")


async def wait_for_place(browser: Browser) -> None:
    """Wait until a download is sent again."""
    status = 503
    while status == 503:
        async with browser.session.get("/api/runs/first.mcap/download/recording.mcap") as response:
            status = response.status
            await response.read()
    assert status == 200


async def test_a_browser_that_stops_reading_loses_its_download(
    daemon: Daemon, tmp_path: Path, recorded: Path
) -> None:
    changes = "from fishd.window import downloads; downloads.STALL_TIMEOUT_S = 0.2"
    write_big(fill(tmp_path / "runs", recorded) / "big.mcap")
    with running_window(tmp_path, fish=daemon.endpoint, changes=changes) as window:
        async with (
            Browser(window.url) as browser,
            unread(window, BIG) as reader,
            unread(window, BIG),
        ):
            await wait_for_place(browser)
            with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
                await reader.readexactly(BIG_BYTES)


async def test_a_device_that_is_revoked_loses_its_download(
    window: WindowProcess, runs: Path
) -> None:
    write_big(runs / "big.mcap")
    async with Browser(window.url, NETWORK_HOST) as browser:
        token = window.invite("watch").rpartition("=")[2]
        await browser.post("/api/pair", {"token": token, "name": "phone"})
        async with browser.session.get(BIG) as response:
            await response.content.readexactly(1)
            window.ask("revoke", "phone")
            while (await browser.get("/api/session"))["paired"]:
                pass
            with pytest.raises(aiohttp.ClientError):
                await response.read()


async def test_a_large_download_takes_little_memory(window: WindowProcess, runs: Path) -> None:
    write_big(runs / "big.mcap")
    write_big(runs / "swept" / "big.png")
    async with Browser(window.url) as browser:
        await browser.get("/api/runs")
        for path in (BIG, "/api/runs/swept/download/all.zip"):
            before, size = peak_memory(window), 0
            async with browser.session.get(path) as response:
                async for chunk in response.content.iter_any():
                    size += len(chunk)
            assert size >= BIG_BYTES
            assert peak_memory(window) - before < 10 * 2**20


def peak_memory(window: WindowProcess) -> int:
    """Return the largest resident size that a window has had [bytes]."""
    status = Path(f"/proc/{window.pid}/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


async def test_a_part_of_a_zip_file_is_not_taken_for_the_whole(
    window: WindowProcess, runs: Path
) -> None:
    write_big(runs / "swept" / "big.png")
    async with (
        Browser(window.url) as browser,
        browser.session.get("/api/runs/swept/download/all.zip") as response,
    ):
        await response.content.readexactly(1)
        (child,) = [pid for pid in list_children(window.pid) if b"\0zip\0" in command_of(pid)]
        os.kill(child, signal.SIGKILL)
        with pytest.raises(aiohttp.ClientError):
            await response.read()


def command_of(pid: int) -> bytes:
    return Path(f"/proc/{pid}/cmdline").read_bytes()
