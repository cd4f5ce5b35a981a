"""Ticks as a table: one row per tick, one column per field."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from fishd.core.errors import MissingPackage
from fishd.core.signals import Tick

if TYPE_CHECKING:
    from pandas import DataFrame


def ticks_to_frame(ticks: Sequence[Tick]) -> "DataFrame":
    """Return ticks as a table with a column per field of `Tick`, in its unit; unset fields are NaN.

    Raise `MissingPackage` without pandas (extra: lab).
    """
    try:
        import pandas
    except ImportError:
        raise MissingPackage.of_extra("a table", "pandas", "lab") from None
    return pandas.json_normalize([msgspec.to_builtins(tick) for tick in ticks])
