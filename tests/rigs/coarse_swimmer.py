"""Free swimmer that is fast to compute, for tests of its surroundings."""

from pathlib import Path

from fishd.config import Config, load
from fishd.virtual.swimmer.kind import FreeSwimmer
from fishd.virtual.swimmer.robot import Swimmer
from rigs.documents import ROOT
from rigs.processes import sets

FILE, UNDAMPED = (ROOT / "config" / f"{name}.yaml" for name in ("swimmer", "swimmer-undamped"))
COARSE = (
    "swimmer.numerics.cell=0.002",
    f"swimmer.numerics.step={0.01 / 6}",
    "swimmer.numerics.fine_length=1.4",
    "swimmer.numerics.fine_width=0.8",
    "swimmer.numerics.stretch_along=1.2",
    "swimmer.numerics.stretch_across=1.2",
    "swimmer.water.length=0.3",
)
OPTIONS = ("--config", str(FILE), *sets(*COARSE))
"""Options of a command line."""


def coarse(*overrides: str, file: Path = FILE) -> Config:
    return load(file, [*COARSE, *overrides])


def swimmer(*overrides: str) -> Swimmer:
    return FreeSwimmer.open(coarse(*overrides))
