"""TCP connections that die without an end, at random instants, below every program that listens.

A path leads to a running fishd and to its camera. At a random instant it forgets its connections,
or forwards nothing for some seconds, or for ever; the connection of requests dies with that of
telemetry, or goes on. Nothing may hang, every lost tick and frame must be counted, and a line must
say so.
"""

import csv
import json
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from argparse import Namespace
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from queue import SimpleQueue

from msgspec import Struct

from common import half_open
from common.daemon import START, TIMEOUT_S
from common.processes import BIN, FISHCTL, Process, call, sets, wait_until
from common.report import Options, Report, progress, table
from fishd.camera.client import CameraClient
from fishd.client import Fish, FishError
from fishd.core.errors import RecordingError
from fishd.lab.swim_log import SWIMS
from fishd.recording import open_run

KINDS = ("forgotten", "for some seconds", "for ever")
"""Ways in which connections die."""
MAX_BEGIN_S = 3.0
"""Largest time from the start of a program to the silence [s]."""
MAX_SILENCE_S = 8.0
"""Largest length of a silence that ends [s]."""
RECOVERY_S = 9.0
"""Time after a silence in which a program must have connected again [s]."""
MAX_END_S = 20.0
"""Largest time from a request to end until the end [s]."""
MARK_PERIOD_S = 0.2
TICK_S = 0.05
"""Period of the ticks of fishd [s]."""
MAX_LOST_TICKS = 8
"""Largest number of ticks that a measurement of 21 s may lack."""
NOTICED = "nothing arrives from its telemetry"
"""Part of the line about a silence."""
LISTENER = """
import sys
from fishd.client import Fish

with Fish(sys.argv[1]) as fish:
    for event in fish.events():
        print(event.t, flush=True)
"""


class Trial(Struct):
    """One silence, and what a program made of it."""

    program: str
    kind: str
    with_control: bool
    """Whether the connection of requests died, too."""
    lost: int | None = None
    """Number of lost ticks or frames; None if it cannot be known."""
    counted: int | None = None
    """Number of lost ticks or frames that the program has reported."""
    hangs: bool = False
    said: bool = True
    """Whether a line says that something was lost, or may have been."""

    @property
    def is_broken(self) -> bool:
        """Whether a promise was not kept."""
        return self.hangs or not self.said or self.lost != self.counted


class Rig:
    """A fishd and a camera on TCP ports of this machine."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        ports = [stack.enter_context(_reserve()).getsockname()[1] for _ in range(4)]
        self.control, self.telemetry, self.requests, self.frames = ports
        self.endpoint = f"tcp://{half_open.HOST}:{self.control}"
        addresses = {"control.address": self.control, "telemetry.address": self.telemetry}
        pairs = [f"{key}=tcp://{half_open.HOST}:{port}" for key, port in addresses.items()]
        own = (f"state_folder={folder}/state", "start.controller=swing", "realtime.priority=0")
        stack.enter_context(Process(*START, *sets(*pairs, *own)))
        wait_until(self.ticks)
        addresses = {"publish.requests": self.requests, "publish.frames": self.frames}
        pairs = [f"{key}=tcp://{half_open.HOST}:{port}" for key, port in addresses.items()]
        source = ("source=simulated", f"simulated.fishd={self.endpoint}", "simulated.rate=20")
        stack.enter_context(Process(str(BIN / "fishd-camera"), *sets(*source, *pairs)))
        camera = f"tcp://{half_open.HOST}:{self.requests}"
        wait_until(lambda: call(FISHCTL, "camera", "status", "--camera", camera).returncode == 0)

    def ticks(self) -> int:
        """Return the number of the latest tick, requested without a path; 0 without an answer."""
        try:
            with Fish(self.endpoint) as fish:
                return fish.status().seq
        except FishError:
            return 0

    def published_frames(self) -> int:
        """Return the number of the latest frame, requested without a path."""
        with CameraClient(f"tcp://{half_open.HOST}:{self.requests}") as camera:
            return camera.status().seq


def _reserve() -> socket.socket:
    """Return a socket that keeps a free port for a program that names it."""
    reserved = socket.socket()
    reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    reserved.bind((half_open.HOST, 0))
    return reserved


class Run:
    """One program at the other end of a separate path."""

    def __init__(self, rig: Rig, host: str, trial: Trial, chance: random.Random) -> None:
        self._rig, self._trial, self._chance = rig, trial, chance
        self._endpoint = f"tcp://{host}:{rig.control}"
        self._camera = f"tcp://{host}:{rig.requests}"
        ports = (rig.control, rig.telemetry, rig.requests, rig.frames)
        self._path = half_open.Path(*ports, host=host)
        own = {"camera": (rig.frames, rig.requests)}
        stream, control = own.get(trial.program, (rig.telemetry, rig.control))
        self._dying = (stream, control) if trial.with_control else (stream,)

    def _disturb(self) -> None:
        """Let the connections die, and wait until they should work again."""
        time.sleep(self._chance.uniform(0.0, MAX_BEGIN_S))
        if self._trial.kind == "forgotten":
            self._path.forget(*self._dying)
        else:
            self._path.cut(*self._dying)
        if self._trial.kind == "for some seconds":
            time.sleep(self._chance.uniform(0.0, MAX_SILENCE_S))
            self._path.restore(*self._dying)
        time.sleep(RECOVERY_S)

    def _end(self, process: Process) -> tuple[int, str, str]:
        """End a program; note whether it hangs."""
        result = (0, "", "")
        try:
            if process.process.poll() is None:
                process.process.send_signal(signal.SIGTERM)
            result = process.finish(MAX_END_S)
        except subprocess.TimeoutExpired:
            self._trial.hangs = True
        return result

    def run(self) -> Trial:
        """Run the program, and compare."""
        with self._path:
            PROGRAMS[self._trial.program](self)
        return self._trial

    def record(self, *words: str) -> None:
        """Record ticks, or also frames."""
        trial = self._trial
        folder = Path(tempfile.mkdtemp(dir=self._rig.folder))
        is_box = trial.program == "black box"
        name = () if is_box else ("run",)
        command = (FISHCTL, "--endpoint", self._endpoint, "record", *name, "--folder", str(folder))
        with Process(*command, "--json", *words) as process:
            wait_until(lambda: _has_ticks(folder))
            self._disturb()
            first_end = self._rig.published_frames()
            status, out, lines = self._end(process)
            last_end = self._rig.published_frames()
        if self._trial.hangs:
            return
        run = open_run(next(folder.glob("*.mcap")))
        what = "frames" if trial.program == "camera" else "ticks"
        reported = [int(number) for number in re.findall(rf"{what} were lost: (\d+)", lines)]
        if trial.program == "camera":
            seqs = [head.seq for head in run.frame_heads]
            trial.counted = sum(reported)
            unknown = "the camera does not answer" in lines
            # What the camera has published when the recording ends lies between these two.
            ends = (seqs[-1],) * 2 if unknown else (first_end, last_end)
            least, most = (max(end, seqs[-1]) - seqs[0] + 1 - len(seqs) for end in ends)
            trial.lost = min(max(trial.counted, least), most)
            trial.said = status == (3 if trial.lost or unknown else 0)
            if trial.kind == "for ever":
                trial.said = trial.said and unknown == trial.with_control
            return
        unknown = "is not known" in lines
        seqs = [tick.seq for tick in run.ticks]
        end = run.statuses[-1].seq if run.statuses else seqs[-1]
        trial.lost = max(end, seqs[-1]) - seqs[0] + 1 - len(seqs)
        trial.counted = sum(reported)
        is_complete = not trial.lost and not unknown
        trial.said = is_box or status == (0 if is_complete else 3)
        if trial.kind == "for ever" and trial.with_control:
            trial.said = trial.said and unknown
        if out.startswith("{"):
            trial.said = trial.said and json.loads(out)["lost_ticks"] == trial.counted

    def record_box(self) -> None:
        """Record into a black box."""
        self.record("--black-box")

    def record_frames(self) -> None:
        """Record ticks and frames."""
        self.record("--camera", self._camera)

    def watch(self) -> None:
        """Watch all ticks, as JSON."""
        trial = self._trial
        path = Path(tempfile.mkdtemp(dir=self._rig.folder)) / "ticks"
        command = (FISHCTL, "--endpoint", self._endpoint, "watch", "--json")
        with path.open("wb") as file, Process(*command, stdout=file) as process:
            wait_until(lambda: path.stat().st_size > 0)
            self._disturb()
            status, _, lines = self._end(process)
        seqs = [json.loads(line)["seq"] for line in path.read_text().splitlines()]
        trial.lost = seqs[-1] - seqs[0] + 1 - len(seqs)
        trial.counted = sum(int(number) for number in re.findall(r"were lost: (\d+)", lines))
        if trial.kind == "for ever":
            trial.said = status == 1 and ("no telemetry" in lines or NOTICED in lines)

    def measure(self) -> None:
        """Measure the thrust."""
        trial = self._trial
        folder = Path(tempfile.mkdtemp(dir=self._rig.folder)) / "measure"
        words = ("measure", "swing", "--for", "21", "--folder", str(folder))
        with Process(FISHCTL, "--endpoint", self._endpoint, *words) as process:
            self._disturb()
            try:
                status, _, lines = process.finish(60.0)
            except subprocess.TimeoutExpired:
                trial.hangs = True
                return
        trial.counted = sum(map(int, re.findall(r"lost on their way from fishd: (\d+)", lines)))
        # The end of a swim that did not end is not in the table; then the measurement fails.
        trial.lost = _lost_in_experiment(folder)
        trial.said = status != 0 or trial.lost <= MAX_LOST_TICKS
        if trial.kind == "for ever":
            trial.said = trial.said and status != 0 and bool(lines)

    def listen(self) -> None:
        """Listen to events, of which there is one in each 0.2 s."""
        trial = self._trial
        command = (sys.executable, "-c", LISTENER, self._endpoint)
        with Process(*command) as process:
            assert process.process.stdout
            process.process.stdout.readline()
            self._disturb()
            now = time.time()
            _, out, lines = self._end(process)
        latest = max(map(float, out.split()), default=0.0)
        if trial.kind == "for ever":
            trial.said = trial.with_control or NOTICED in lines
        else:
            trial.hangs = trial.hangs or now - latest > 2.0
            gaps = _longest_gap([float(t) for t in out.split()])
            trial.said = gaps < 1.0 or "arrives again" in lines or "comes again" in lines


PROGRAMS: dict[str, Callable[[Run], None]] = {
    "record": Run.record,
    "black box": Run.record_box,
    "camera": Run.record_frames,
    "watch": Run.watch,
    "events": Run.listen,
    "measure": Run.measure,
}


def _has_ticks(folder: Path) -> bool:
    try:
        return bool(open_run(next(folder.glob("*.part"))).ticks)
    except (StopIteration, RecordingError):
        return False


def _lost_in_experiment(folder: Path) -> int:
    """Return how many ticks of the swims and rests in the table the recordings lack."""
    seqs = [tick.seq for path in folder.glob("*.mcap*") for tick in open_run(path).ticks]
    lost = 0
    if (table := folder / SWIMS).exists():
        for row in csv.DictReader(table.read_text().splitlines()):
            stored = sum(int(row["first_tick"]) <= seq <= int(row["last_tick"]) for seq in seqs)
            lost += round(float(row["seconds"]) / TICK_S) - stored
    return lost


def _longest_gap(times: list[float]) -> float:
    return max((after - before for before, after in pairwise(times)), default=0.0)


OPTIONS: Options = {
    "--number": {"type": int, "default": 20, "help": "of silences for each program; default 20"},
    "--seed": {"type": int, "default": 1, "help": "default 1"},
    "--only": {"choices": tuple(PROGRAMS), "help": "try this program alone"},
}


def measure(options: Namespace) -> Report:
    """Let connections die below all programs; ten minutes."""
    chance = random.Random(options.seed)
    hosts: SimpleQueue[str] = SimpleQueue()
    for number in range(2, 10):
        hosts.put(f"127.0.0.{number}")
    lease = threading.Lock()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        rig = Rig(Path(name), stack)
        stopped = threading.Event()
        marker = threading.Thread(target=_mark, args=(rig, stopped))
        marker.start()

        def run(trial: Trial, seed: float) -> Trial:
            with lease if trial.program == "measure" else ExitStack():
                host = hosts.get()
                try:
                    result = Run(rig, host, trial, random.Random(seed)).run()
                finally:
                    hosts.put(host)
            progress(f"{result}")
            return result

        programs = [options.only] if options.only else list(PROGRAMS)
        trials = [
            (Trial(program, chance.choice(KINDS), chance.random() < 0.5), chance.random())
            for number in range(options.number)
            for program in programs
        ]
        with ThreadPoolExecutor(8) as pool:
            done = list(pool.map(lambda pair: run(*pair), trials))
        stopped.set()
        marker.join(TIMEOUT_S)
    rows = []
    for program in programs:
        own = [trial for trial in done if trial.program == program]
        known = [trial for trial in own if trial.lost is not None]
        rows.append(
            [
                program,
                f"{len(own)}",
                f"{sum(trial.hangs for trial in own)}",
                f"{sum(trial.lost or 0 for trial in known)}" if known else "–",
                f"{sum(trial.counted or 0 for trial in known)}" if known else "–",
                f"{sum(not trial.said or trial.lost != trial.counted for trial in own)}",
            ]
        )
    head = "program | silences | hang | lost | counted | silent losses"
    text = (
        f"{table(head, rows)}\n\nSeed {options.seed}. Lost ticks and frames are those that the "
        "files lack; frames after the last one in a file are counted from what the camera, asked "
        "directly before and after the end, has published, unless the recorder says that it "
        "cannot know them."
    )
    broken = any(trial.is_broken for trial in done)
    silent = sum(not trial.said or trial.lost != trial.counted for trial in done)
    result = (
        f"{silent} silent losses and {sum(trial.hangs for trial in done)} hangs in {len(done)} "
        f"silences; {sum(trial.counted or 0 for trial in done)} lost ticks and frames counted"
    )
    return Report({"reliability half_open": text}, done, broken=broken, number=result)


def _mark(rig: Rig, stopped: threading.Event) -> None:
    """Publish events until stopped."""
    with Fish(rig.endpoint) as fish:
        while not stopped.wait(MARK_PERIOD_S):
            fish.mark("a mark")
