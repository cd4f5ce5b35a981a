"""The commands of the page about clusters, on schedulers and workers on the loopback interface."""

import os
import shlex
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from rigs.documents import FENCE, ROOT, text_of
from rigs.processes import PATIENCE

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

PAGE = ROOT / "docs" / "how-to" / "cluster.md"
SRUN = """\
#!/bin/sh
while [ "$1" != dask ]; do shift; done
exec "$@" --host 127.0.0.1
"""
"""A stand-in that starts one task, here."""


def test_the_job_script_sweeps_on_its_own_workers(tmp_path: Path) -> None:
    [script] = [block for kind, block in FENCE.findall(text_of(PAGE)) if kind == "bash"]
    assert "0.4:4:0.2" in script
    (tmp_path / "job.sh").write_text(script.replace("0.4:4:0.2", "1,2"))
    (tmp_path / "srun").write_text(SRUN)
    (tmp_path / "srun").chmod(0o755)
    path = [str(tmp_path), str(Path(sys.executable).parent), os.environ["PATH"]]
    slurm = {"SLURM_JOB_ID": "7", "SLURM_NTASKS": "1", "PATH": os.pathsep.join(path)}
    with (tmp_path / "log").open("w") as log:
        job = subprocess.Popen(
            ["bash", "job.sh"],
            cwd=tmp_path,
            env={**os.environ, **slurm},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        try:
            status = job.wait(PATIENCE)
        finally:
            os.killpg(job.pid, signal.SIGKILL)  # Slurm ends what runs beside the script
    assert status == 0, (tmp_path / "log").read_text()
    assert len((tmp_path / "runs/waves/rows.csv").read_text().splitlines()) == 1 + 4


def test_dask_has_the_options_of_the_page() -> None:
    lines = [line for _, block in FENCE.findall(text_of(PAGE)) for line in block.splitlines()]
    calls = [shlex.split(line)[2:] for line in lines if line.startswith("$ dask ")]
    assert {kind for kind, *_ in calls} == {"scheduler", "worker"}
    for kind, *words in calls:
        import_module(f"distributed.cli.dask_{kind}").main.make_context(kind, words)
