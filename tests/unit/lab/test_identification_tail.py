"""Identification of a fish from its forces and the fin angle that a camera measured."""

from collections.abc import Callable
from dataclasses import replace as replaced
from pathlib import Path

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner
from msgspec.structs import asdict, replace
from rigs.seen_tail import SeenTail

from fishd.cli.main import fishctl
from fishd.config import load
from fishd.core.tail_reading import RecordedTail
from fishd.lab.fin_angle import FinAngles
from fishd.lab.identification import Identification, Unidentifiable, experiment, identify
from fishd.lab.identification.figure import draw
from fishd.lab.session import VirtualSession
from fishd.recording import Run, open_run

FISH = ("plant.coupling=0.4", "plant.lateral_inertia_ratio=0.7", "plant.omega0=11")
FACTORS = ("coupling", "thrust_coefficient", "lateral_inertia_ratio", "lateral_drag")
"""λ, K, K_y/K and K_d: forces alone determine only products of them."""
FIT = ("omega0", "servo_delay", *FACTORS)
PLANT = load(None, FISH).plant
START = replace(PLANT, coupling=0.46, lateral_inertia_ratio=1.0, omega0=12.5)


def swim(folder: Path, *, seed: int = 0, seconds: float = 40.0, **camera: float) -> Run:
    """Return a recording of an experiment with fin angles."""
    with VirtualSession(load(None, (*FISH, f"simulation.seed={seed}"))) as session:
        session.fin_angles = FinAngles(SeenTail(session, **camera), warn=pytest.fail)
        path = folder / "identify.mcap"
        with session.heard_by(session.fin_angles), session.recorded(path, "a test"):
            experiment(session, seconds)
    return open_run(path)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return swim(tmp_path_factory.mktemp("tail"), scale=1.004)


@pytest.fixture(scope="module")
def identification(run: Run) -> Identification:
    return identify(run, start=START, fit=FIT, tail_scale=0.01)


def changed(run: Run, change: Callable[[RecordedTail], RecordedTail]) -> Run:
    """Return the same recording with other fin angles."""
    other = open_run(run.path)
    other.tails = [change(tail) for tail in run.tails]
    return other


def refit(run: Run, *, fix: tuple[str, ...] = (), scale: float = 0.01) -> Identification:
    return identify(run, start=START, fit=FIT, fix=fix, tail_scale=scale)


def test_each_factor_is_known_as_well_as_the_scale_of_the_camera(
    identification: Identification,
) -> None:
    truth = asdict(PLANT)
    for name, width in zip(FACTORS, (0.01, 0.02, 0.015, 0.01), strict=True):
        estimate = identification[name]
        assert estimate.ci95_low < truth[name] < estimate.ci95_high, name
        assert estimate.ci95_high - estimate.ci95_low < 2.6 * width * truth[name], name
        assert estimate.if_ratio_holds is None
    assert identification.headline.endswith("; the fin angles determine λ, K, K_y and K_d")
    for product in identification.products:
        assert product.ci95_high < 1.02 * product.ci95_low
    assert identification.leak == pytest.approx(0.7 * 12.9e-3 / 39.9e-3, rel=0.01)


def test_delay_and_zero_of_the_camera_are_found(identification: Identification) -> None:
    assert identification.fin_angle is not None
    delay, zero = identification.fin_angle.estimates
    assert (delay.name, zero.name) == ("camera_delay", "fin_angle_zero")
    assert delay.value == pytest.approx(0.02, abs=1e-3)
    assert delay.ci95_high - delay.ci95_low < 1e-3
    assert zero.value == pytest.approx(0.01, abs=5e-4)
    assert identification.fin_angle.noise == pytest.approx(2e-3, rel=0.1)
    assert identification.fin_angle.explained > 0.99
    result = msgspec.json.decode(msgspec.json.encode(identification.to_builtins()))
    assert result["fin_angle"]["estimates"]["camera_delay"]["unit"] == "s"


def test_without_them_the_forces_determine_what_they_did(run: Run) -> None:
    tables = [table := run.frame(), table.drop(columns=["fin_angle", "fin_angle_uncertainty"])]
    with_angles, without = (
        identify(table, start=PLANT, fit=("omega0",)).to_builtins() for table in tables
    )
    assert with_angles == without
    assert "fin_angle" not in without


def test_where_the_scale_of_the_fish_is_known_that_of_the_camera_is_measured(run: Run) -> None:
    known = replace(START, coupling=PLANT.coupling)
    fit = identify(run, start=known, fit=FIT, fix=("coupling",), tail_scale=0.02).fin_angle
    assert fit is not None
    assert fit.estimates[2].name == "fin_angle_scale"
    assert fit.estimates[2].value == pytest.approx(1.004, abs=1e-3)


def test_the_fin_angles_at_the_ticks_of_a_table_do_too(run: Run) -> None:
    identification = identify(run.frame(), start=START, fit=FIT, tail_scale=0.05)
    assert identification["coupling"].value == pytest.approx(0.4, rel=0.01)
    half_width = 0.5 * (identification["coupling"].ci95_high - identification["coupling"].ci95_low)
    assert half_width == pytest.approx(0.05 * 0.4, rel=0.1)


def test_the_figure_has_a_row_for_the_fin_angle(
    identification: Identification, tmp_path: Path
) -> None:
    draw(identification, tmp_path / "tail.svg")
    draw(replaced(identification, fin_angle=None), tmp_path / "forces.svg")
    texts = [(tmp_path / name).read_text() for name in ("tail.svg", "forces.svg")]
    assert [text.count("residual (mrad)") for text in texts] == [1, 0]
    fit = identification.fin_angle
    assert fit is not None
    assert fit.measured == pytest.approx(fit.simulated, abs=0.01)
    assert len(fit.times) == fit.used + fit.left_out


def test_a_mirrored_picture_is_reported_and_counts(
    run: Run, identification: Identification
) -> None:
    mirrored = refit(changed(run, lambda tail: replace(tail, alpha=-(tail.alpha or 0.0))))
    assert mirrored["coupling"].value == pytest.approx(identification["coupling"].value, rel=1e-4)
    assert mirrored.fin_angle is not None
    assert mirrored.fin_angle.estimates[1].value == pytest.approx(-0.01, abs=5e-4)
    assert mirrored.remarks[-1].startswith("the picture shows the tail mirrored")


def test_wrong_fin_angles_are_left_out_and_counted(
    run: Run, identification: Identification
) -> None:
    spoil = {tail.seq for tail in run.tails[::20]}
    spoiled = refit(
        changed(run, lambda t: replace(t, alpha=(t.alpha or 0) + 0.2 * (t.seq in spoil)))
    )
    assert spoiled["coupling"].value == pytest.approx(identification["coupling"].value, rel=2e-3)
    assert spoiled.fin_angle is not None
    count = spoiled.fin_angle.left_out
    assert count == pytest.approx(len(run.tails) / 20, rel=0.2)
    assert any(remark.startswith(f"{count} of ") for remark in spoiled.remarks)


def test_a_scale_that_the_forces_contradict_is_reported(run: Run) -> None:
    larger = changed(run, lambda tail: replace(tail, alpha=1.2 * (tail.alpha or 0.0)))
    known = replace(START, coupling=PLANT.coupling)
    fit = identify(larger, start=known, fit=FIT, fix=("coupling",), tail_scale=0.01)
    assert fit.remarks[-1].startswith("forces and fin angles disagree on ")
    assert "fin_angle_scale" in fit.remarks[-1]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            lambda t: replace(t, alpha=None, reason="glare") if t.seq % 20 else t,
            "fin angles are known while the fish swims: 200 or more are needed; most are unknown "
            "because: glare",
        ),
        (lambda t: replace(t, alpha=0.05 * (t.alpha or 0.0)), "mrad only: a recording of a fish"),
        (
            lambda t: replace(t, alpha=float(np.sin(40.0 * t.time))),
            "the fin angle does not follow φ_c",
        ),
    ],
)
def test_fin_angles_that_determine_nothing_are_refused(
    run: Run, change: Callable[[RecordedTail], RecordedTail], complaint: str
) -> None:
    with pytest.raises(Unidentifiable, match=complaint):
        identify(changed(run, change), start=PLANT, fit=("servo_delay",), tail_scale=0.01)


def test_a_run_without_any_is_refused_by_name(run: Run) -> None:
    without = changed(run, lambda tail: tail)
    without.tails = []
    with pytest.raises(Unidentifiable, match=r"identify\.mcap: it has no fin angles; record"):
        identify(without, fit=("omega0",), tail_scale=0.01)


def test_the_verb_prints_the_camera_and_the_factors(run: Run) -> None:
    words = ("--tail", "--tail-scale", "0.02", "--fit", ",".join(FIT))
    done = CliRunner().invoke(fishctl, ["identify", str(run.path), *words])
    assert done.exit_code == 0, done.output
    assert "\ncamera_delay " in done.stdout
    assert "\nfin angle: noise 2.0" in done.stdout
    assert "if K_y/K" not in done.stdout
    refused = CliRunner().invoke(fishctl, ["identify", "--experiment", "--tail"])
    assert "--tail is for --on live" in refused.stderr
