"""The dated files that calibrations are kept in.

None is ever overwritten; the newest one of a kind is used.
"""

import datetime
import math
import re
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from fishd.core import files, strict_yaml
from fishd.core.calibration import C, ForceCalibration, ServoCalibration
from fishd.core.errors import ConfigError
from fishd.core.schema import Problem, convert

_STAMP = "%Y-%m-%dT%H%M%S.%fZ"
_NAME = re.compile(r"(force|servo)-(?P<stamp>\d{4}-\d\d-\d\dT\d{6}\.\d{6}Z)\+*\.yaml", re.ASCII)
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
        """The newest calibration and its file; None where none was ever saved.

        Raises `ConfigError` where the folder cannot be read, or the newest file cannot, is not
        whole or makes no sense: an older one, or a default, would be wrong silently.
        """
        names = self._names(kind)
        if not names:
            return None
        path = self.folder / names[-1]
        try:
            text = files.read_text(path, files.SETTINGS, "a calibration")
            return _whole(strict_yaml.parse(text).data, kind), path
        except strict_yaml.YamlProblem as problem:
            raise ConfigError(f"{path}:{problem.line}: {problem}; {_REMEDY}") from None
        except Problem as problem:
            raise ConfigError(f"{path}: {problem.located({})}; {_REMEDY}") from None
        except files.FileProblem as problem:
            raise ConfigError(f"{path}: {problem}; {_REMEDY}") from None

    def save(self, calibration: C, now: datetime.datetime) -> tuple[C, Path]:
        """Write a new file, dated `now`; the calibration with its date, and the path.

        Raises OSError when it cannot be written, and `ConfigError` as `newest` does. An older file
        is never touched, and the new one sorts after it, even where the clock went back.
        """
        dated = msgspec.structs.replace(calibration, date=now.isoformat(timespec="seconds"))
        self.folder.mkdir(parents=True, exist_ok=True)
        stem = f"{_NAMES[type(calibration)]}-{now.astimezone(datetime.UTC):{_STAMP}}"
        names = self._names(type(calibration))
        if names and stem <= Path(names[-1]).stem:
            stem = f"{Path(names[-1]).stem}+"
        path = self.folder / f"{stem}.yaml"
        text = strict_yaml.dump(msgspec.to_builtins(dated))
        files.write_atomically(path, text, new=True)
        files.sync_folder(self.folder)
        return dated, path

    def ignored(self) -> list[str]:
        """Return a line about each file named like a calibration but without a date.

        Raises `ConfigError` if the folder cannot be read.
        """
        return [
            f"{self.folder / name} is no dated calibration file and is ignored"
            for name in sorted(self._all())
            if not _is_dated(name)
        ]

    def _names(self, kind: type[C]) -> list[str]:
        """Return the names of the files of a kind, oldest first."""
        start = f"{_NAMES[kind]}-"
        names = [name for name in self._all() if name.startswith(start) and _is_dated(name)]
        return sorted(names, key=lambda name: Path(name).stem)

    def _all(self) -> list[str]:
        try:
            found = [path.name for path in self.folder.iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"{self.folder}: cannot be read: {error.strerror}") from None
        starts = tuple(f"{name}-" for name in _NAMES.values())
        return [name for name in found if name.startswith(starts) and name.endswith(".yaml")]


def check(calibration: C) -> C:
    """The same calibration; raises `Problem` unless it makes sense."""
    for key, value in msgspec.structs.asdict(calibration).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise Problem((key,), f"{value} is not a finite number")
        if key in ("date", "tared") and value and not _is_date(value):
            raise Problem((key,), f"'{value}' is no date: one in ISO 8601 is needed")
    if isinstance(calibration, ForceCalibration):
        if calibration.singular:
            raise Problem((), "the matrix xx xy, yx yy says the same of both forces")
        _check_uncertainty(calibration)
    return calibration


def _check_uncertainty(calibration: ForceCalibration) -> None:
    """Raise `Problem` where a number is not a possible uncertainty."""
    for key in ("covariance_x", "covariance_y"):
        covariance = getattr(calibration, key)
        if covariance is None:
            continue
        first, both, second = covariance
        possible = min(first, second) >= 0.0 and both * both <= first * second * (1.0 + 1e-9)
        if not (possible and all(map(math.isfinite, covariance))):
            raise Problem(
                (key,),
                f"{list(covariance)} is not a covariance: variance, covariance and variance of "
                "two gains are needed",
            )
    if calibration.load_error is not None and calibration.load_error < 0.0:
        raise Problem(("load_error",), f"{calibration.load_error:g} is negative")


def _is_dated(name: str) -> bool:
    """Is it the name of a file as `save` makes it?"""
    found = _NAME.fullmatch(name)
    if not found:
        return False
    try:
        datetime.datetime.strptime(found["stamp"], _STAMP)
    except ValueError:
        return False
    return True


def _is_date(text: str) -> bool:
    try:
        datetime.datetime.fromisoformat(text)
    except ValueError:
        return False
    return True


def _whole(data: Any, kind: type[C]) -> C:
    """The calibration that a file holds; raises `Problem` unless it is whole and makes sense."""
    if not data:
        raise Problem((), "there is nothing in this file")
    if not isinstance(data, dict):
        raise Problem((), "a mapping of keys to values is needed")
    missing = [key for key in _REQUIRED[kind] if key not in data]
    if missing:
        raise Problem((), f"without {', '.join(missing)}: nothing is filled in")
    calibration = convert(data, kind)
    if isinstance(calibration, ForceCalibration) and not calibration.date:
        raise Problem(("date",), "'' is not when it was made")
    return check(calibration)
