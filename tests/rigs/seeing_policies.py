"""Untrained networks for pictures, with a feature extractor after a random excitation."""

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy

from fishd.camera.simulated import DEFAULT
from fishd.config import Config
from fishd.controllers.policy.card import Card, Window
from fishd.learning import extractors
from fishd.learning.env.environment import features
from fishd.learning.env.perception import Perception
from fishd.learning.links.simulated_link import Camera, SimulatedLink
from fishd.learning.ppo import make_policy
from fishd.learning.run_folder.runs import make_card
from fishd.learning.settings import TrainingSettings

SPREAD = 30.0
"""Factor of the last layer relative to a new network, so that actions differ."""


def randomly_excited(settings: TrainingSettings) -> tuple[Card, ActorCriticPolicy, Perception]:
    """Return the state of a training after its random excitation."""
    config, extractor = Config(), extractors.make_extractor(settings)
    assert extractor
    link = SimulatedLink(config, camera=Camera(DEFAULT, extractor.stack))
    link.reset()
    frames, angles = [], []
    for angle in extractors.random_angles(settings.seed, 200, config.amplitude_limit).tolist():
        link.step(angle)
        if (stack := link.look()) is not None:
            frames.append(stack[0])
            angles.append(angle)
    extractor.fit(np.stack(frames), np.array(angles))
    inputs = features(config, settings.seen)
    torch.manual_seed(settings.seed)
    history = settings.seen.history
    perception = Perception(inputs, extractor, Window(history, history * config.tick))
    policy = make_policy(settings.ppo, perception.numbers, extractor)
    policy.set_training_mode(False)
    with torch.no_grad():
        for parameter in policy.action_net.parameters():
            parameter.mul_(SPREAD)
    card = make_card(config, settings, inputs, "simulation", 0, None, "")
    return card, policy, perception
