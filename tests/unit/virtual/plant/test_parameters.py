import sys
from typing import get_type_hints

import msgspec
import pytest
from rigs.processes import call

from fishd.virtual.plant.parameters import PlantParameters


@pytest.mark.slow
def test_reading_parameters_costs_no_numpy() -> None:
    program = "import sys, fishd.virtual.plant.parameters; sys.exit('numpy' in sys.modules)"
    assert call(sys.executable, "-c", program).returncode == 0


def test_every_parameter_has_bounds_a_unit_and_a_description() -> None:
    hints = get_type_hints(PlantParameters, include_extras=True)
    for name in PlantParameters.__struct_fields__:
        if name in ("model", "servo_law"):
            continue
        (meta,) = hints[name].__metadata__
        assert meta.description.endswith("."), name
        assert meta.extra_json_schema["unit"], name
        assert meta.le is not None, name
        assert meta.ge is not None or meta.gt is not None, name


@pytest.mark.parametrize(
    "wrong", [{"xi": -0.1}, {"servo_lag": 0.0}, {"omega0": "fast"}, {"xi": 21.0}, {"damping": 1.0}]
)
def test_a_fish_that_cannot_exist_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(wrong, PlantParameters)
