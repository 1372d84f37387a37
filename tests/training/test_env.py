"""Refused settings and actions of the environment, and the pictures of a game."""

# mypy: disable-error-code="arg-type, union-attr, misc"

from __future__ import annotations

import importlib
import importlib.util

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from PIL import ImageColor

from merge_sumo import training
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import COLOURS
from merge_sumo.training.env import MergeEnv
from merge_sumo.training.registration import ENV_ID


@pytest.fixture
def no_screen(monkeypatch):
    """Let windows be drawn nowhere."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.mark.parametrize("action", [-1, 7, 2.0, None, "3"])
def test_anything_but_an_action_is_refused(action):
    game = MergeEnv("vut")
    game.reset(seed=1)
    with pytest.raises(UserError, match="an action must be a whole number from 0 to 6, not"):
        game.step(action)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"role": "bus"}, "a bus cannot play against 'level0': `role` must be pov or vut"),
        ({"role": "vut", "svo": 0.5}, "svo is 0.5: .* for a POV"),
        ({"opponent": "pov1"}, "cannot play against 'pov1'"),
        ({"opponent": "vut1", "svo": "selfish"}, "svo is .*: choose 'random', or for a POV"),
        ({"opponent": "vut1", "svo": float("nan")}, "svo is .*: choose 'random', or for a POV"),
    ],
)
def test_wrong_settings_are_refused(settings, sentence):
    with pytest.raises(UserError, match=sentence):
        MergeEnv(**settings)


@pytest.mark.parametrize("role", ["pov", "vut"])
@pytest.mark.usefixtures("no_screen")
def test_the_environment_passes_gymnasiums_checker_with_its_pictures(role):
    check_env(gymnasium.make(ENV_ID, role=role, render_mode="rgb_array").unwrapped)


def test_cars_are_drawn_to_scale_in_the_colours_of_the_player():
    game = MergeEnv("vut", render_mode="rgb_array")
    game.reset(seed=3)
    has_ended = False
    while not has_ended:
        (x_pov_m, _, x_vut_m, _), _, has_ended, _, _ = game.step(5)
    frame = game.render()
    assert (frame.shape, frame.dtype) == ((240, 960, 3), np.uint8)
    pov = np.argwhere((frame == ImageColor.getrgb(COLOURS["pov"])).all(axis=2))
    vut = np.argwhere((frame == ImageColor.getrgb(COLOURS["vut"])).all(axis=2))
    # At M, where the paths have met, the view is as wide as both cars and 50 m, or 90 m.
    px_per_m = 960.0 / max(abs(x_pov_m - x_vut_m) + 50.0, 90.0)
    apart_m = (pov[:, 1].max() - vut[:, 1].max()) / px_per_m
    assert apart_m == pytest.approx(x_pov_m - x_vut_m, abs=0.3)
    height_px, length_px = np.ptp(pov, axis=0) + 1
    assert length_px == pytest.approx(5.0 * px_per_m, abs=2.0)
    assert height_px == pytest.approx(2.0 * px_per_m, abs=2.0)


@pytest.mark.usefixtures("no_screen")
@pytest.mark.filterwarnings("ignore:.*HumanRendering")
def test_gymnasium_shows_the_pictures_in_a_window():
    import pygame

    game = gymnasium.make(ENV_ID, role="vut", render_mode="human")
    game.reset(seed=3)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
    drawn = MergeEnv("vut", render_mode="rgb_array")
    drawn.reset(seed=3)
    assert np.array_equal(shown, drawn.render())
    game.close()


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"training needs torch, .*`pip install 'merge-sumo\[train"):
        importlib.reload(training)
