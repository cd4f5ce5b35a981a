"""The sensitivity of a policy to parts of its pictures, computed by hiding them."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rigs.policy_files import FLIP, of_pixels, seeing_card, velocity_follower, write

from fishd.camera.axis import NoMotion
from fishd.camera.simulated import DEFAULT
from fishd.cli.main import fishctl
from fishd.config import Config
from fishd.core.errors import FishdError, ParameterError, PolicyError
from fishd.learning.look import look


def test_a_policy_that_follows_the_tail_is_sensitive_where_the_tail_moves(tmp_path: Path) -> None:
    result = look(str(write(tmp_path, velocity_follower())), Config(), DEFAULT, 12.0)
    assert result.mean.shape == result.sensitivity.shape == result.moves.shape == (32, 32)
    assert 0.05 < result.area < 0.3
    assert result.share > 2.0 * result.area
    row, column = np.unravel_index(result.sensitivity.argmax(), (32, 32))
    assert 8 <= row < 24
    assert column > 8
    assert not result.moves[:4].any()


def test_a_sensitive_corner_is_found(tmp_path: Path) -> None:
    about = seeing_card()
    weights = np.zeros((2, 32, 32))
    halves = np.where(np.arange(32) < 16, 1.0, -1.0)[:, None] * np.full(32, 2.0 / 32**2)
    weights[:2] = 4.0 * halves, -4.0 * halves
    weights[0, :4, 28:] += 0.03  # the noise of a corner influences the policy
    weights[1, :4, 28:] -= 0.03
    path = write(tmp_path, of_pixels(weights, about), "corner")
    result = look(str(path), Config(), DEFAULT, 12.0)
    assert result.sensitivity[1, 30] > 3.0 * result.sensitivity[1, 1]


def test_a_policy_that_sees_nothing_or_does_not_swim_or_react_is_refused(tmp_path: Path) -> None:
    def refused(content: bytes, error: type[FishdError], seconds: float = 8.0) -> str:
        with pytest.raises(error) as caught:
            look(str(write(tmp_path, content)), Config(), DEFAULT, seconds)
        return str(caught.value)

    assert "it sees no pictures, so it looks at nothing" in refused(FLIP, PolicyError)
    nothing = np.zeros((2, 32, 32))
    blind = of_pixels(nothing, seeing_card())
    assert "nothing in the pictures moves it" in refused(blind, PolicyError)
    nothing[0, 0, 0] = 1e-6
    timid = of_pixels(nothing, seeing_card())
    assert "nothing moves in these pictures" in refused(timid, NoMotion, 25.0)
    assert "is too short" in refused(velocity_follower(), ParameterError, 4.0)


def test_the_verb_prints_the_share_in_a_line_and_draws_the_sensitivity(tmp_path: Path) -> None:
    policy, picture = write(tmp_path, velocity_follower(), "eye"), tmp_path / "look.png"
    words = ["learn", "look", str(policy), "--plot", str(picture), "--seconds", "10"]
    done = CliRunner().invoke(fishctl, words)
    assert done.exit_code == 0, done.output
    result, drawn = done.output.splitlines()
    assert result.startswith(f"{policy}: ")
    assert "% of the sensitivity lies where the tail moves, on " in result
    assert drawn == f"drawn: {picture}"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_figure_with_an_unknown_format_is_refused_before_the_swim(tmp_path: Path) -> None:
    policy = str(write(tmp_path, velocity_follower(), "eye"))
    done = CliRunner().invoke(fishctl, ["learn", "look", policy, "--plot", "a.gif"])
    assert "a figure has no format .gif" in str(done.exception)
