"""A network that begins with a blind one's weights does what that one does, whatever it sees, and learns to see."""

from dataclasses import replace

import pytest
import torch

from lowlevel.networks.actor import Critic, ObservationSizes, PilotActor, TargetEncoder
from lowlevel.networks.config import NetworkConfig
from lowlevel.networks.sight import give_sight
from robots.errors import PilotError

SIZES = ObservationSizes(frame=24, history_length=2, elevation_map=121, privileged=150, action=7)
SEEING = NetworkConfig(output_gain=1.0)
BLIND = replace(SEEING, vision=False)
MASK = torch.arange(SIZES.frame) < 4


def observed(robots: int = 64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return torch.randn(robots, SIZES.history), torch.randn(robots, 121), torch.ones(robots, 1)


@pytest.mark.parametrize("mixture", [True, False])
@pytest.mark.parametrize("attention", [True, False])
def test_until_it_makes_use_of_the_map_it_acts_as_the_blind_one(mixture: bool, attention: bool) -> None:
    blind = PilotActor(SIZES, replace(BLIND, mixture=mixture), MASK)
    blind.normalizer.update(3.0 + torch.randn(500, SIZES.frame))
    actor = PilotActor(SIZES, replace(SEEING, mixture=mixture, attention=attention), MASK)
    give_sight(actor, blind.state_dict())
    observation = observed()
    for ours, theirs in zip(actor(*observation), blind(*observation), strict=True):
        torch.testing.assert_close(ours, theirs)
    actor(*observation).mean.square().sum().backward()
    head = next(p for name, p in actor.head.named_parameters() if name in ("first.weight", "hidden.0.weight"))
    assert head.grad is not None and bool((head.grad[:, -actor.perception_size :] != 0.0).any())


def test_its_critic_values_as_the_blind_one() -> None:
    privileged = torch.randn(64, SIZES.privileged)
    for build in (Critic, TargetEncoder):
        blind, seeing = build(SIZES, BLIND), build(SIZES, SEEING)
        give_sight(seeing, blind.state_dict())
        seen = SIZES.privileged - SIZES.elevation_map
        theirs = blind(privileged[:, :seen] if build is TargetEncoder else privileged)
        torch.testing.assert_close(seeing(privileged), theirs)


def test_weights_of_another_architecture_are_refused() -> None:
    actor = PilotActor(SIZES, SEEING, MASK)
    other = PilotActor(SIZES, replace(BLIND, history_hidden=(32, 64)), MASK)
    with pytest.raises(PilotError, match="another architecture: 'history_encoder"):
        give_sight(actor, other.state_dict())
    with pytest.raises(PilotError, match="another architecture"):
        give_sight(actor, PilotActor(SIZES, replace(BLIND, mixture=False), MASK).state_dict())
