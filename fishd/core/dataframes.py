"""Ticks as a table: one row a tick, one column a field."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from fishd.core.errors import MissingPackage
from fishd.core.signals import Tick

if TYPE_CHECKING:
    from pandas import DataFrame


def frame(ticks: Sequence[Tick]) -> "DataFrame":
    """The ticks as a table: a column a field of `Tick`, in its unit; fields that are unset are NaN.

    Raises `MissingPackage` without pandas (extra: lab).
    """
    try:
        import pandas
    except ImportError:
        raise MissingPackage(
            "a table needs the package pandas; with pip: pip install 'fishd[lab]'"
        ) from None
    return pandas.json_normalize([msgspec.to_builtins(tick) for tick in ticks])
