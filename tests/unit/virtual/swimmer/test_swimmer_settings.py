"""Configuration of a swimmer: its errors, and that it loads no heavy modules."""

import sys
from pathlib import Path

import pytest
from rigs.coarse_swimmer import FILE, OPTIONS
from rigs.processes import FISHCTL, FISHD, addresses, call, fishctl, one_line

from fishd.config import load
from fishd.core.errors import ConfigError

CHECKS = f"""
import sys
from fishd.config import load
from fishd.core.errors import ConfigError
load({str(FILE)!r})
print([name for name in ("numba", "scipy") if name in sys.modules])
"""


@pytest.mark.slow
def test_a_configuration_is_checked_without_loading_the_solver() -> None:
    done = call(sys.executable, "-c", CHECKS)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("tick=0.0125", "tick: 0.0125 s is not a multiple of swimmer.numerics.step, "
         "0.0004 s; 0.0124 s would be"),
        ("swimmer.numerics.cell=0.005", "swimmer.numerics.cell: 0.005 m is too coarse"),
        ("swimmer.numerics.step=0.005", "swimmer.numerics.step: 0.005 s is beyond the limit"),
        ("swimmer.body.length=0.3", "swimmer.water.width: a tank of 0.2 m is too small"),
        ("swimmer.muscle.strain=8", "swimmer.muscle.strain: 8 folds the body"),
        ("estimator.kind=observer", "estimator.kind: observer is not valid with robot: swimmer"),
        ("robot=simulated", "estimator.kind: tail is not valid with robot: simulated"),
        ("swimmer.body.viscosity=8", "estimator.kind: tail is not valid with a swimmer.body.visc"),
        ("lockstep=true", "lockstep: true is not valid with robot: swimmer"),
    ],
)  # fmt: skip
def test_settings_that_contradict_one_another_are_refused_with_their_key(
    override: str, complaint: str
) -> None:
    done = fishctl("config", "check", str(FILE), "--set", override)
    assert done.returncode == 78
    assert complaint in one_line(done)


def test_the_profile_that_a_complaint_gives_as_an_example_is_accepted() -> None:
    with pytest.raises(ConfigError, match="rising from 0 to 1") as refusal:
        load(FILE, ["swimmer.body.profile=[[0, 0]]"])
    example = str(refusal.value).partition("such as ")[2]
    assert load(FILE, [f"swimmer.body.profile={example}"]).swimmer.body.profile


@pytest.mark.parametrize("profile", ["[[0, 0.3], [1, 0.02]]", "[[0, 0.02], [1, 0.3]]"])
def test_small_cells_that_end_before_the_fish_does_are_refused(profile: str) -> None:
    body = [f"swimmer.body.profile={profile}"]
    with pytest.raises(ConfigError, match=r"swimmer\.numerics\.fine_length: 1\.2") as refusal:
        load(FILE, [*body, "swimmer.numerics.fine_length=1.2"])
    least = str(refusal.value).rpartition("at least ")[2]
    assert 1.3 < float(least) < 1.4
    load(FILE, [*body, f"swimmer.numerics.fine_length={least}"])


@pytest.mark.parametrize("viscosity", ["1e-4", "1e-3"])
def test_advection_and_viscosity_share_one_limit_of_the_step(viscosity: str) -> None:
    water = [f"swimmer.water.viscosity={viscosity}", "swimmer.numerics.cell=0.001"]
    with pytest.raises(ConfigError, match="the tail would pass") as refusal:
        # With 1e-4, ν Δt/h² is 0.06: each of the two alone would permit this step.
        load(FILE, [*water, "swimmer.numerics.step=0.0006"])
    longest = str(refusal.value).rpartition("at most ")[2].removesuffix(" s")
    tick = round(0.01 / float(longest)) * float(longest)
    load(FILE, [*water, f"swimmer.numerics.step={longest}", f"tick={tick:.9g}"])


def test_other_robots_ignore_the_settings_of_a_swimmer() -> None:
    assert load(None, ["swimmer.numerics.cell=0.005"]).robot == "simulated"


@pytest.mark.slow
@pytest.mark.parametrize("program", [FISHD, FISHCTL])
def test_a_package_that_is_missing_is_named_with_its_extra(tmp_path: Path, program: str) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['numba'] = None\n")
    simulates = ("simulate", "swing", "--seconds", "4") if program == FISHCTL else ()
    own = addresses(tmp_path) if program == FISHD else ()
    done = call(program, *simulates, *OPTIONS, *own, env={"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 1
    assert "numba" in done.stderr
    assert done.stderr.endswith("[swimmer]'\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ("measure", "swing", "--on", "simulation"),
        ("compare", "swing", "square"),
        ("optimise", "square", "--frequency", "1:3"),
        ("optimum",),
        ("identify", "--experiment"),
    ],
)
def test_verbs_about_the_thrust_of_a_tethered_fish_refuse_a_swimmer(words: tuple[str, ...]) -> None:
    complaint = one_line(fishctl(*words, "--config", str(FILE)))
    assert "robot: swimmer is not valid for" in complaint
    assert "set robot: simulated" in complaint
