"""The flows of `tools/bench swimmer`, on coarse grids."""

import pytest

from bench import swimmer_flows


def test_a_swimmer_that_undulates_like_an_eel_gathers_speed_as_on_the_page() -> None:
    """The page has 0.080 and 0.299 lengths per period with 100 cells, 0.092 and 0.337 with 400."""
    assert swimmer_flows.undulate(100, 2.0) == pytest.approx([0.080, 0.299], rel=0.02)
