"""The package in docs/example-plant, installed and used as its reader would."""

from pathlib import Path

import pytest
from rigs import processes
from rigs.documents import ROOT
from rigs.example_packages import fishctl
from rigs.processes import PATIENCE, running, sets, wait_until

from fishd.client import Fish
from fishd.config import load, to_yaml
from fishd.lab.simulation import simulate
from fishd.learning.env.fish_variation import episode_fish
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.settings import Randomisation
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.registry import open_plant
from fishd.virtual.plant.tethered import TetheredFish

pytestmark = pytest.mark.slow  # it starts processes
EXAMPLES = "example-plant"
PAGE = ROOT / "docs" / "how-to" / "writing-a-plant.md"
MODEL = "plant.model=two-segments"
THRUST = 0.01495
"""Mean thrust of `swing` with C = 0.6 [N]."""


@pytest.mark.usefixtures("_installed")
def test_without_a_tip_it_is_the_fish_of_the_paper() -> None:
    ours = open_plant(load(None, [MODEL, "plant.tip_share=0"]).plant)
    papers = TetheredFish(PlantParameters())
    for k in range(8):
        angle = None if k == 5 else 0.42 * (-1) ** k
        window, expected = ours.advance(angle, 0.31, 31), papers.advance(angle, 0.31, 31)
        assert ours.state == pytest.approx(papers.state, abs=1e-6)
        assert window.thrust == pytest.approx(expected.thrust, abs=1e-7)
        assert window.lateral_force == pytest.approx(expected.lateral_force, abs=1e-6)
        assert window.sampled_thrust == pytest.approx(expected.sampled_thrust, abs=1e-6)
        assert window.fin_peak == pytest.approx(expected.fin_peak, rel=1e-3)


@pytest.mark.usefixtures("_installed")
def test_it_swims_in_a_sweep_of_its_own_key(tmp_path: Path) -> None:
    sweep = ["sweep", "square", "--frequency", "1.4", "--vary", "plant.tip_share=0.1,0.3"]
    out = ["--periods", "3", "--jobs", "1", "--settle", "2", "--folder", str(tmp_path / "sweep")]
    done = processes.fishctl(*sweep, *out, "--set", MODEL)
    assert done.returncode == 0, done.stderr
    rows = (tmp_path / "sweep" / "rows.csv").read_text().splitlines()
    column = rows[0].split(",").index("thrust")
    stiff, soft = (float(row.split(",")[column]) for row in rows[1:])
    assert stiff > 1.2 * soft


@pytest.mark.usefixtures("_installed")
def test_it_swims_behind_the_drivers_of_a_virtual_pi() -> None:
    config = load(None, [MODEL, "robot=virtual-pi"])
    report = simulate(config, "swing", {"C": 0.6}, 6.0, 2.5)
    assert report.mode == "running"
    assert report.mean_thrust == pytest.approx(THRUST, rel=0.05)


@pytest.mark.usefixtures("_installed")
def test_an_agent_learns_on_it_and_on_fish_like_it() -> None:
    link = SimulatedLink(load(None, [MODEL]), episode_fish(Randomisation(omega0=0.3)))
    for seed in (1, 2):
        link.reset(seed=seed)
        forces = [link.step(0.4 * (-1) ** (k // 7)).observation.fx for k in range(70)]
        assert sum(forces[28:]) / 42 > 0.005
    assert link.config.plant.omega0 != 12.5
    assert link.config.plant.model == "two-segments"


@pytest.mark.usefixtures("_installed")
@pytest.mark.parametrize("lockstep", ["false", "true"])
def test_it_swims_in_a_true_fishd_which_reports_its_keys(tmp_path: Path, lockstep: str) -> None:
    mine = sets(MODEL, "plant.tip_xi=0.8", f"lockstep={lockstep}", "start.controller=swing")
    with running(tmp_path, *mine) as daemon, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert fish.config()["plant"]["tip_xi"] == 0.8
        wait_until(lambda: fish.status().seq > 20)
        assert fish.status().mode == "running"


@pytest.mark.usefixtures("_installed")
def test_a_configuration_with_it_can_be_written_and_read(tmp_path: Path) -> None:
    config = load(None, [MODEL, "plant.tip_omega0=30"])
    (tmp_path / "fish.yaml").write_text(to_yaml(config))
    assert load(tmp_path / "fish.yaml") == config


@pytest.mark.usefixtures("_installed")
def test_what_it_has_no_equation_for_is_refused_by_key() -> None:
    done = processes.fishctl("simulate", "swing", *sets(MODEL, "plant.backlash=0.1"))
    assert done.returncode == 78
    assert done.stderr == (
        "fishctl: --set plant.backlash=0.1: plant.backlash: 0.1 is not valid: this "
        "plant has none; 0 is needed\n"
    )


def test_the_page_about_it_shows_what_a_run_prints(site: Path) -> None:
    page = PAGE.read_text(encoding="utf-8")
    command = "simulate swing --C 0.6 --set plant.model=two-segments"
    shown = page.partition(f"$ fishctl {command}\n")[2].partition("timing ")[0]
    assert shown == fishctl(site, *command.split()).stdout.split("timing ")[0]
