"""Dated files that contain calibrations.

No file is ever overwritten; the newest file of each kind is used.
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
_REMEDY = "repair the file, or move it away"


class CalibrationFolder:
    """Folder with the dated calibration files of one robot."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def newest(self, kind: type[C]) -> tuple[C, Path] | None:
        """Return the newest calibration and its file; None if none was ever saved.

        Raises `ConfigError` if the folder or the newest file cannot be read, or if that file is
        incomplete or invalid: an older calibration, or a default, would be silently wrong.
        """
        names = self._dated_names(kind)
        if not names:
            return None
        path = self.folder / names[-1]
        try:
            text = files.read_text(path, files.MAX_SETTINGS_BYTES, "a calibration")
            return _load(strict_yaml.parse(text).data, kind), path
        except strict_yaml.YamlProblem as problem:
            raise ConfigError(f"{path}:{problem.line}: {problem}; {_REMEDY}") from None
        except Problem as problem:
            raise ConfigError(f"{path}: {problem.message_with_place({})}; {_REMEDY}") from None
        except files.FileProblem as problem:
            raise ConfigError(f"{path}: {problem}; {_REMEDY}") from None

    def save(self, calibration: C, now: datetime.datetime) -> tuple[C, Path]:
        """Write a new file, dated `now`; return the calibration with its date, and the path.

        Older files are never changed, and the new file sorts after them even if the clock was set
        back. Raises OSError if the file cannot be written, and `ConfigError` as `newest` does.
        """
        dated = msgspec.structs.replace(calibration, date=now.isoformat(timespec="seconds"))
        self.folder.mkdir(parents=True, exist_ok=True)
        stem = f"{_NAMES[type(calibration)]}-{now.astimezone(datetime.UTC):{_STAMP}}"
        names = self._dated_names(type(calibration))
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
            f"{self.folder / name} is not a dated calibration file and is ignored"
            for name in sorted(self._file_names())
            if not _is_dated(name)
        ]

    def _dated_names(self, kind: type[C]) -> list[str]:
        """Return the names of the files of a kind, oldest first."""
        prefix = f"{_NAMES[kind]}-"
        names = [name for name in self._file_names() if name.startswith(prefix) and _is_dated(name)]
        return sorted(names, key=lambda name: Path(name).stem)

    def _file_names(self) -> list[str]:
        try:
            names = [path.name for path in self.folder.iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"{self.folder}: cannot be read: {error.strerror}") from None
        prefixes = tuple(f"{name}-" for name in _NAMES.values())
        return [name for name in names if name.startswith(prefixes) and name.endswith(".yaml")]


def check(calibration: C) -> C:
    """Return the same calibration; raise `Problem` if it is not valid."""
    for key, value in msgspec.structs.asdict(calibration).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise Problem((key,), f"{value} is not a finite number")
        if key in ("date", "tare_date") and value and not _is_date(value):
            raise Problem((key,), f"'{value}' is not a date: one in ISO 8601 is needed")
    if isinstance(calibration, ForceCalibration):
        if calibration.is_singular:
            raise Problem(
                (), "the matrix xx xy, yx yy is singular: it cannot tell the two forces apart"
            )
        _check_uncertainty(calibration)
    return calibration


def _check_uncertainty(calibration: ForceCalibration) -> None:
    """Raise `Problem` if a number is not a possible uncertainty."""
    for key in ("covariance_x", "covariance_y"):
        covariance = getattr(calibration, key)
        if covariance is None:
            continue
        variance_1, covariance_12, variance_2 = covariance
        possible = min(variance_1, variance_2) >= 0.0 and (
            covariance_12 * covariance_12 <= variance_1 * variance_2 * (1.0 + 1e-9)
        )
        if not (possible and all(map(math.isfinite, covariance))):
            raise Problem(
                (key,),
                f"{list(covariance)} is not a covariance: variance, covariance and variance of "
                "two gains are needed",
            )
    if calibration.load_ci95 is not None and calibration.load_ci95 < 0.0:
        raise Problem(("load_ci95",), f"{calibration.load_ci95:g} is negative")


def _is_dated(name: str) -> bool:
    """Return whether `save` could have written a file of this name."""
    match = _NAME.fullmatch(name)
    if not match:
        return False
    try:
        datetime.datetime.strptime(match["stamp"], _STAMP)
    except ValueError:
        return False
    return True


def _is_date(text: str) -> bool:
    try:
        datetime.datetime.fromisoformat(text)
    except ValueError:
        return False
    return True


def _load(data: Any, kind: type[C]) -> C:
    """Return the calibration in a file; raise `Problem` if it is incomplete or not valid."""
    if not data:
        raise Problem((), "the file is empty")
    if not isinstance(data, dict):
        raise Problem((), "a mapping of keys to values is needed")
    missing = [key for key in _REQUIRED[kind] if key not in data]
    if missing:
        raise Problem((), f"{', '.join(missing)} missing: fishd fills in no default")
    calibration = convert(data, kind)
    if isinstance(calibration, ForceCalibration) and not calibration.date:
        raise Problem(("date",), "'' is not a date: one in ISO 8601 is needed")
    return check(calibration)
