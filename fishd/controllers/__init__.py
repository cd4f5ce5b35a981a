"""The controllers: an observation in, an instruction angle out.

None of them uses a clock, a socket or a file while the fish swims, except `remote`, which waits for
the answer of its agent. `policy/` reads its file before it takes over.
"""

from fishd.controllers.base import Amplitude, Controller, Limits, amplitude_of
from fishd.controllers.quantities import quantity
from fishd.core.errors import ParameterError
from fishd.core.schema import note, unit
from fishd.core.signals import Observation

__all__ = [
    "Amplitude",
    "Controller",
    "Limits",
    "Observation",
    "ParameterError",
    "amplitude_of",
    "note",
    "quantity",
    "unit",
]
