"""Errors of plants of other packages, and the messages of fishd."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.example_packages import forget_drivers
from rigs.processes import install

from fishd.config import json_schema, load
from fishd.core.errors import ConfigError, FishLost, StartupError
from fishd.lab.simulation.virtual_run import KeepingPublisher, VirtualRun
from fishd.virtual.plant.registry import open_plant

pytestmark = pytest.mark.slow

CODE = """
from typing import Annotated
from msgspec import Struct
from fishd.virtual.plant.base import *

class Keys(PlantParameters, frozen=True, forbid_unknown_fields=True, kw_only=True):
    size: Annotated[float, unit("m", "Of the tail.", gt=0, le=1)] = 0.1

class Good(Plant):
    Settings = Keys

    def __init__(self, parameters):
        super().__init__(parameters)
        self.state = REST

    def advance(self, angle, duration, samples):
        self.state = PlantState(angle or 0.0, self.parameters.size, 0.0)
        return PlantWindow(duration, 0.01, 0.02, 0.01, 0.02, 0.1)

class Unable(Good):
    def __init__(self, parameters):
        raise RuntimeError("no tank")

class Breaking(Good):
    def advance(self, angle, duration, samples):
        raise SystemExit("out of water")

class Dividing(Good):
    def advance(self, angle, duration, samples):
        return PlantWindow(duration, float("nan"), 0.0, 0.0, 0.0, 0.0)

class Silent(Good):
    def advance(self, angle, duration, samples):
        return None

class Unfinished(Plant):
    Settings = Keys

class Foreign(Struct):
    size: float = 0.1

class Unrelated(Good):
    Settings = Foreign

class Plain(Good):
    Settings = PlantParameters

class Listing(Good):
    class Settings(PlantParameters, frozen=True, kw_only=True):
        lengths: list[float] = []

class Choosy(Good):
    @classmethod
    def check(cls, parameters):
        raise Problem(("size",), "0.1 m is longer than the tank")
"""
NAMES = (
    *("good", "unable", "breaking", "dividing", "silent", "unfinished"),
    *("unrelated", "plain", "listing", "choosy"),
)


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    module = f"plants_{tmp_path.name}"  # of this test alone
    classes = {name: f"{module}:{name.capitalize()}" for name in NAMES}
    install(tmp_path, {module: CODE}, group="fishd.plants", **classes)
    monkeypatch.syspath_prepend(str(tmp_path))
    forget_drivers()
    yield
    forget_drivers()


def test_a_plant_of_another_package_is_what_the_sensor_feels_and_keeps_its_keys() -> None:
    config = load(None, ["plant.model=good", "plant.size=0.25", "simulation.noise=0"])
    publisher = KeepingPublisher()
    with VirtualRun(config, publisher) as run:
        windows = [run.tick() for _ in range(3)]
    assert [(tick.fx, tick.fy, tick.alpha) for tick in publisher.ticks] == [(0.01, 0.02, 0.25)] * 3
    assert windows[0].thrust == 0.01


def test_the_schema_knows_its_keys_and_takes_the_others_that_add_none() -> None:
    schema = json_schema()
    models = {}
    for ref in schema["$defs"]["Config"]["properties"]["plant"]["anyOf"]:
        keys = schema["$defs"][ref["$ref"].rpartition("/")[2]]["properties"]
        models |= dict.fromkeys(keys["model"]["enum"], "size" in keys)
    assert models["tethered"] is False
    assert models["plain"] is False
    assert models["good"] is True


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (["plant.model=unfinished"], "does not define advance"),
        (["plant.model=unrelated"], "has no Settings, a subclass of fishd.virtual.plant.param"),
        (["plant.model=listing"], "has keys that cannot be compared between fish: numbers, "),
        (["plant.model=choosy"], "plant.size: 0.1 m is longer than the tank"),
        (["plant.model=good", "plant.size=2"], "2 is not valid: a number in (0, 1] m is needed"),
        (["plant.model=good", "plant.sizes=2"], "plant.sizes: unknown key; did you mean 'size'?"),
        (["plant.size=0.2"], "unknown key with model tethered; models that have it: "),
        (["plant.model=godo"], "no plant is named 'godo', did you mean 'good'?; installed: "),
    ],
)
def test_a_plant_that_cannot_be_used_is_one_line(settings: list[str], complaint: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, settings)
    assert complaint in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_one_that_cannot_begin_says_why() -> None:
    with pytest.raises(StartupError, match=r"^plant 'unable' cannot begin: RuntimeError: no tank$"):
        open_plant(load(None, ["plant.model=unable"]).plant)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("breaking", "SystemExit: out of water"),
        ("dividing", "its forces or its state are not finite"),
        ("silent", "'NoneType' object has no attribute 'thrust'"),
    ],
)
def test_one_that_cannot_go_on_is_the_fault_fish_lost(name: str, why: str) -> None:
    config = load(None, [f"plant.model={name}"])
    with pytest.raises(FishLost, match=f"^plant '{name}' cannot go on: .*{why}"):
        open_plant(config.plant).advance(0.1, 0.05, 10)
    publisher = KeepingPublisher()
    with VirtualRun(config, publisher) as run:
        assert run.tick().thrust == 0.0
        reason = run.loop.supervisor.reason
    assert reason.code == "fish-lost"
    assert why in reason.message
