"""Calibrations of force sensor and servo, and the dated files that they are kept in.

A file is never overwritten; the newest one of a kind is in force.
"""

import datetime
import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from fishd import strict_yaml
from fishd.errors import ConfigError
from fishd.hardware.settings import ServoSettings
from fishd.schema import Problem, convert

WORST_CONDITION = 1e5
"""A matrix of a larger condition number says the same of both forces; that of a fit is less."""


class ForceCalibration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """F_x = xx V_x + xy V_y + x0 and F_y = yx V_x + yy V_y + y0; volts to newtons."""

    xx: float = 1.0
    """[N/V]"""
    xy: float = 0.0
    x0: float = 0.0
    """[N]"""
    yx: float = 0.0
    yy: float = 1.0
    y0: float = 0.0
    date: str = ""
    """When it was made, ISO 8601; empty for one that nobody made."""
    loads: int = 0
    """How many loads it was fitted to; 0 for one that was not."""
    residual: float = 0.0
    """Root mean square of what the fit leaves over [N]."""
    condition: float = 0.0
    """Condition number of the fit."""
    tared: str = ""
    """When x0 and y0 were last set by a tare, ISO 8601; empty for never."""

    def forces(self, vx: float, vy: float) -> tuple[float, float]:
        """F_x and F_y [N] for two voltages [V]."""
        return (
            self.xx * vx + self.xy * vy + self.x0,
            self.yx * vx + self.yy * vy + self.y0,
        )

    @property
    def singular(self) -> bool:
        """True where the matrix, whatever its size, does not tell F_x from F_y."""
        gains = (self.xx, self.xy, self.yx, self.yy)
        largest = max(map(abs, gains))
        if largest == 0.0:
            return True
        xx, xy, yx, yy = (gain / largest for gain in gains)
        # With singular values s and t: s t = |det|, s² + t² = sum of squares, condition = s / t.
        squares = xx * xx + xy * xy + yx * yx + yy * yy
        determinant = abs(xx * yy - xy * yx)
        return squares > determinant * (WORST_CONDITION + 1.0 / WORST_CONDITION)


class ServoCalibration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the same keys of section `servo` mean, with their bounds; takes precedence over them."""

    trim: Annotated[float, Meta(ge=-500, le=500)] = 0.0
    """[µs]"""
    direction: Literal[1, -1] = 1
    scale: Annotated[float, Meta(ge=10, le=5000)] = 600.0
    """[µs/rad]"""
    lowest: Annotated[float, Meta(ge=-math.pi, le=0)] = -1.2
    """[rad]"""
    highest: Annotated[float, Meta(ge=0, le=math.pi)] = 1.2
    """[rad]"""
    date: str = ""


def calibrated(settings: ServoSettings, calibration: ServoCalibration) -> ServoSettings:
    """The settings with what a calibration says instead."""
    return msgspec.structs.replace(
        settings,
        trim=calibration.trim,
        direction=calibration.direction,
        scale=calibration.scale,
        lowest=calibration.lowest,
        highest=calibration.highest,
    )


def as_configured(settings: ServoSettings) -> ServoCalibration:
    """The calibration that the settings themselves amount to."""
    return ServoCalibration(
        trim=settings.trim,
        direction=settings.direction,
        scale=settings.scale,
        lowest=settings.lowest,
        highest=settings.highest,
    )


class ForceSample(Struct, frozen=True):
    """What the force sensor said over a while; means and standard deviations over pairs."""

    pairs: int
    seconds: float
    vx: float
    """[V]"""
    vy: float
    vx_std: float
    vy_std: float
    fx: float
    """By the calibration in force [N]."""
    fy: float
    suspect: str = ""
    """Why this is not to be believed; empty where it is."""
    number: int = 0
    """By which a tare names it, for a while."""


C = TypeVar("C", ForceCalibration, ServoCalibration)

_STAMP = "%Y-%m-%dT%H%M%S.%fZ"
_NAMES: dict[type[Struct], str] = {ForceCalibration: "force", ServoCalibration: "servo"}
_REQUIRED: dict[type[Struct], tuple[str, ...]] = {
    ForceCalibration: ("xx", "xy", "x0", "yx", "yy", "y0", "date"),
    ServoCalibration: ("trim", "direction", "scale", "lowest", "highest"),
}
_REMEDY = "mend it, or move it away"


class CalibrationFolder:
    """The folder with the dated files of one robot."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def newest(self, kind: type[C]) -> tuple[C, Path] | None:
        """The calibration in force and its file; None where none was ever saved.

        Raises `ConfigError` where the folder cannot be read, or the newest file cannot, is not
        whole or makes no sense: an older one, or a default, would be wrong silently.
        """
        names = self._names(kind)
        if not names:
            return None
        path = self.folder / names[-1]
        try:
            return _checked(strict_yaml.parse(path.read_text(encoding="utf-8")).data, kind), path
        except strict_yaml.YamlProblem as problem:
            raise ConfigError(f"{path}:{problem.line}: {problem}; {_REMEDY}") from None
        except Problem as problem:
            where = ".".join(problem.path) + ": " if problem.path else ""
            raise ConfigError(f"{path}: {where}{problem}; {_REMEDY}") from None
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from None

    def save(self, calibration: C, now: datetime.datetime) -> tuple[C, Path]:
        """Write a new file, dated `now`; the calibration with its date, and the path.

        Raises OSError when it cannot be written, and `ConfigError` as `newest` does. An older file
        is never touched, and the new one sorts after it, even where the clock went back.
        """
        import yaml

        dated = msgspec.structs.replace(calibration, date=now.isoformat(timespec="seconds"))
        self.folder.mkdir(parents=True, exist_ok=True)
        stem = f"{_NAMES[type(calibration)]}-{now.astimezone(datetime.UTC):{_STAMP}}"
        names = self._names(type(calibration))
        if names and stem <= Path(names[-1]).stem:
            stem = f"{Path(names[-1]).stem}+"
        path = self.folder / f"{stem}.yaml"
        text = yaml.safe_dump(msgspec.to_builtins(dated), sort_keys=False)
        temporary = path.with_suffix(".part")
        with temporary.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        path.hardlink_to(temporary)  # unlike a rename, never onto another file
        temporary.unlink()
        folder = os.open(self.folder, os.O_RDONLY)
        try:
            os.fsync(folder)  # else a power cut takes the name away again
        finally:
            os.close(folder)
        return dated, path

    def _names(self, kind: type[C]) -> list[str]:
        """The files of a kind, oldest first."""
        try:
            found = [path.name for path in self.folder.iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"{self.folder}: cannot be read: {error.strerror}") from None
        start = f"{_NAMES[kind]}-"
        names = [name for name in found if name.startswith(start) and name.endswith(".yaml")]
        return sorted(names, key=lambda name: Path(name).stem)


def _checked(data: Any, kind: type[C]) -> C:
    """The calibration that a file holds; raises `Problem` unless it is whole and makes sense."""
    if not data:
        raise Problem((), "there is nothing in this file")
    if not isinstance(data, dict):
        raise Problem((), "a mapping of keys to values is needed")
    missing = [key for key in _REQUIRED[kind] if key not in data]
    if missing:
        raise Problem((), f"without {', '.join(missing)}: nothing is filled in")
    calibration = convert(data, kind)
    for key, value in msgspec.structs.asdict(calibration).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise Problem((key,), f"{value} is not a finite number")
    if isinstance(calibration, ForceCalibration):
        if not calibration.date:
            raise Problem(("date",), "'' is not when it was made")
        if calibration.singular:
            raise Problem((), "the matrix xx xy, yx yy says the same of both forces")
    return calibration
