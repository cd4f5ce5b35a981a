"""`fishctl window` and `fishd-window`: they open a page that runs, start one, and end in order."""

import json
import re
import signal
from pathlib import Path

import pytest
from rigs.processes import FISHCTL, Daemon, Process, fishctl, one_line, wait_until
from rigs.window_process import Browser, WindowProcess, open_page, running_window


@pytest.mark.parametrize(("verb", "place"), [("window open", ""), ("camera page", "#camera")])
def test_a_page_that_runs_is_opened_and_not_started_again(
    window: WindowProcess, verb: str, place: str
) -> None:
    done = fishctl(*verb.split(), "--listen", f"127.0.0.1:{window.port}")
    assert (done.returncode, done.stdout) == (0, f"the fish is at {window.url}/{place}\n")


async def test_a_page_that_does_not_run_is_started_until_ctrl_c(
    daemon: Daemon, tmp_path: Path
) -> None:
    options = ["--listen", "127.0.0.1:0", "--state", str(tmp_path)]
    with Process(FISHCTL, "--endpoint", daemon.endpoint, "window", "open", *options) as process:
        assert process.process.stdout
        line = process.process.stdout.readline()
        match = re.fullmatch(r"the fish is at (http://127\.0\.0\.1:\d+)/\n", line)
        assert match

        async with Browser(match[1]) as browser, open_page(browser) as page:
            await page.until("ticks")
        assert process.end(signal.SIGINT)[0] == 0


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--listen", "8880"], "--listen: listen: '8880' is not valid: HOST:PORT is needed"),
        (["--listen", "127.0.0.1:99999"], "HOST:PORT is needed, such as 127.0.0.1:8880"),
        (["--fish", "tuna"], "'tuna' is not valid: NAME=ENDPOINT is needed"),
        (["--fish", "a/b=ipc:///x"], "up to 40 letters, digits, dots and dashes are needed"),
        (["--fish", "tuna=here"], "'here' is not valid: tcp://HOST:PORT or ipc://PATH is needed"),
        (["--state", "/proc/none"], "/proc/none cannot be created"),
        (["--listen", "192.0.2.1:8880"], "cannot serve a page at 192.0.2.1:8880"),
    ],
)
def test_a_wrong_option_is_one_line(tmp_path: Path, words: list[str], complaint: str) -> None:
    with WindowProcess(tmp_path, *words) as process:
        status, _, errors = process.finish()
    assert status != 0
    assert complaint in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("fishes: {}", "fishes: unknown key; did you mean 'fish'?"),
        ("cameras: {tuna: ipc:///x}", "cameras.tuna: is not the name of a fish; here: fish"),
        (
            "cameras: {fish: /dev/video0}",
            "cameras.fish: '/dev/video0' is not valid: tcp://HOST:PORT or ipc://",
        ),
    ],
)
def test_a_wrong_key_is_named_with_its_line(tmp_path: Path, line: str, complaint: str) -> None:
    file = tmp_path / "window.yaml"
    file.write_text(f"listen: 127.0.0.1:8880\n{line}\n")
    shown = one_line(fishctl("window", "devices", "--config", str(file)))
    assert f"window.yaml:2: {complaint}" in shown


async def test_the_end_of_the_window_stops_its_fish_and_its_experiments(
    new_window: WindowProcess, daemon: Daemon, tmp_path: Path
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        job = {"fish": "fish", "kind": "record", "options": {"name": "endless"}}
        await page.post("/api/jobs", job)
        await page.until("job", lambda j: "recording to" in "".join(j["lines"]))
        await page.swim()
        new_window.process.send_signal(signal.SIGTERM)
        while not page.sock.closed:
            await page.sock.receive()
    new_window.process.wait()
    assert new_window.process.returncode == 0
    wait_until(lambda: daemon.status().mode == "idle")
    assert daemon.status().lease is None
    assert (tmp_path / "runs" / "endless.mcap").exists()


def test_a_window_that_runs_is_found_by_its_state_folder(daemon: Daemon, tmp_path: Path) -> None:
    state = ("--state", str(tmp_path / "window"))
    refused = one_line(fishctl("window", "pair", *state))
    assert "the page listens at 127.0.0.1:8880, which no other device reaches" in refused
    options = ("--listen", "0.0.0.0:0")
    with running_window(tmp_path, *options, fish=daemon.endpoint) as process:
        link = json.loads(process.ask("pair", "--json"))["url"]
        assert re.fullmatch(rf"http://[^/]+:{process.port}/#pair=[\w-]{{22}}", link)
        opened = process.ask("open")
        assert opened == f"the fish is at http://127.0.0.1:{process.port}/\n"
    assert [path.name for path in process.state.glob("window-*")] == []
