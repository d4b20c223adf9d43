"""The PILOT networks (paper, section III-B): history encoder, mixture-of-experts actor and critic.

Tensors are batched along the first axis, N. The default widths are small: the policy trains on two CPU cores.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from lowlevel.networks.config import NetworkConfig, ObservationSizes, perceptron
from lowlevel.networks.map_encoder import MapEncoder, PlainMapEncoder
from lowlevel.networks.normalizer import RunningNormalizer

__all__ = ["ActorOutput", "Critic", "NetworkConfig", "ObservationSizes", "PilotActor", "TargetEncoder"]

MOTION_SIZE = 5
"""Components of the motion that is estimated: the base's linear velocity (3) and the capture point (2)."""

CAPTURE_POINT = slice(3, 5)


class ActorOutput(NamedTuple):
    """What the actor computes for N observations."""

    mean: Tensor
    """Mean action (N, A)."""
    gate: Tensor
    """Probability of each expert (N, E); ones (N, 1) for the monolithic ablation."""
    motion: Tensor
    """Estimated base linear velocity [m/s] and capture point [m] (N, 5), heading frame."""
    latent: Tensor
    """Predicted latent of the next state (N, latent), unit length."""


def small_output_(weight: Tensor, bias: Tensor, gain: float) -> None:
    """Make an output layer start near zero: orthogonal weight of the given gain, zero bias."""
    nn.init.orthogonal_(weight, gain)
    nn.init.zeros_(bias)


class HistoryEncoder(nn.Module):
    """History and map to the robot's motion and next-state latent.

    Paper III-B-1; the estimator of PIM (arXiv 2411.14386), which has the velocity alone. Where a robot that stands will
    topple to is as much worth knowing, and takes all joints to tell.
    """

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig) -> None:
        super().__init__()
        outputs = MOTION_SIZE + config.latent
        self.vision = config.vision
        inputs = sizes.history + (sizes.elevation_map if config.vision else 0)
        self.layers = perceptron(inputs, config.history_hidden, outputs)

    def forward(self, history: Tensor, elevation_map: Tensor) -> tuple[Tensor, Tensor]:
        """Normalized history (N, H) and map (N, M) to motion (N, 5) and unit latent (N, latent)."""
        inputs = torch.cat([history, elevation_map], dim=1) if self.vision else history
        outputs = self.layers(inputs)
        return outputs[:, :MOTION_SIZE], functional.normalize(outputs[:, MOTION_SIZE:], dim=1)


class MixtureOfExperts(nn.Module):
    """``sum_i p_i a_i`` over E experts that see the same input (paper III-B-2).

    The experts' first layers are one wide linear layer, the others are batched over experts.
    """

    def __init__(self, inputs: int, outputs: int, config: NetworkConfig) -> None:
        super().__init__()
        first, second = config.expert_hidden
        self.experts = config.experts
        self.gate_layers = perceptron(inputs, (config.gate_hidden,), config.experts)
        self.first = nn.Linear(inputs, config.experts * first)
        self.second_weight = nn.Parameter(torch.empty(config.experts, first, second))
        self.second_bias = nn.Parameter(torch.empty(config.experts, 1, second))
        self.output_weight = nn.Parameter(torch.empty(config.experts, second, outputs))
        self.output_bias = nn.Parameter(torch.empty(config.experts, 1, outputs))
        bound = 1.0 / math.sqrt(first)
        nn.init.uniform_(self.second_weight, -bound, bound)
        nn.init.uniform_(self.second_bias, -bound, bound)
        for weight, bias in zip(self.output_weight, self.output_bias, strict=True):
            small_output_(weight, bias, config.output_gain)
        last = self.gate_layers[-1]
        assert isinstance(last, nn.Linear)
        small_output_(last.weight, last.bias, 0.1)

    def proposals(self, inputs: Tensor) -> Tensor:
        """Each expert's action (E, N, outputs) for ``inputs`` (N, inputs)."""
        hidden = functional.elu(self.first(inputs)).unflatten(1, (self.experts, -1)).transpose(0, 1)
        hidden = functional.elu(torch.baddbmm(self.second_bias, hidden, self.second_weight))
        return torch.baddbmm(self.output_bias, hidden, self.output_weight)

    @torch.no_grad()
    def silence(self, outputs: slice) -> None:
        """Make these outputs zero for good."""
        self.output_weight[..., outputs], self.output_bias[..., outputs] = 0.0, 0.0

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """``inputs`` (N, inputs) to the blended action (N, outputs) and gate probabilities (N, E)."""
        gate = torch.softmax(self.gate_layers(inputs), dim=1)
        return (gate.T.unsqueeze(-1) * self.proposals(inputs)).sum(dim=0), gate


class MonolithicActor(nn.Module):
    """The ablation "w/o MoE": one MLP."""

    def __init__(self, inputs: int, outputs: int, config: NetworkConfig) -> None:
        super().__init__()
        self.hidden = perceptron(inputs, config.monolithic_hidden, 1)[:-1]
        self.output = nn.Linear(config.monolithic_hidden[-1], outputs)
        small_output_(self.output.weight, self.output.bias, config.output_gain)

    @torch.no_grad()
    def silence(self, outputs: slice) -> None:
        """Make these outputs zero for good."""
        self.output.weight[outputs], self.output.bias[outputs] = 0.0, 0.0

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """``inputs`` (N, inputs) to the action (N, outputs) and a gate of ones (N, 1)."""
        hidden = self.hidden(inputs)
        return self.output(hidden), torch.ones_like(hidden[:, :1])


class PilotActor(nn.Module):
    """The policy: history encoder, map encoder and mixture of experts, with its own observation scaling.

    Motion and latent enter the policy detached, as in the HIM family of estimators: no policy gradient
    reaches the history encoder, which learns from its own loss (:mod:`lowlevel.learning.estimation`). The exploration
    noise is one ``log_std`` per action, independent of the state.
    """

    def __init__(
        self,
        sizes: ObservationSizes,
        config: NetworkConfig,
        command_columns: Tensor,
        initial_std: float = 0.5,
    ) -> None:
        """``command_columns`` (F,) bool: frame columns that have a fixed scale and are not normalized."""
        super().__init__()
        self.sizes = sizes
        self.config = config
        self.normalizer = RunningNormalizer(sizes.frame, command_columns)
        self.history_encoder = HistoryEncoder(sizes, config)
        encoder = MapEncoder if config.attention else PlainMapEncoder
        self.map_encoder: nn.Module = encoder(sizes, config).requires_grad_(config.vision)
        self.perception_size = config.map_global + config.attention_width if config.vision else 0
        inputs = self.perception_size + config.latent + MOTION_SIZE + sizes.frame + 1
        head = MixtureOfExperts if config.mixture else MonolithicActor
        self.head: MixtureOfExperts | MonolithicActor = head(inputs, sizes.action, config)
        self.log_std = nn.Parameter(torch.full((sizes.action,), math.log(initial_std)))

    def estimator_parameters(self) -> list[nn.Parameter]:
        """Parameters of the history encoder."""
        return list(self.history_encoder.parameters())

    def policy_parameters(self) -> list[nn.Parameter]:
        """Parameters that the policy gradient trains."""
        estimator = {id(parameter) for parameter in self.estimator_parameters()}
        return [p for p in self.parameters() if p.requires_grad and id(p) not in estimator]

    def silence(self, actions: slice) -> None:
        """Leave these actions at zero for good: for actions that were never trained."""
        self.head.silence(actions)

    def encode(self, history: Tensor, elevation_map: Tensor) -> tuple[Tensor, Tensor]:
        """Raw history (N, H) and map (N, M) [m] to motion (N, 5) and unit latent (N, latent)."""
        frames = self.normalizer(history.unflatten(1, (-1, self.sizes.frame)))
        return self.history_encoder(frames.flatten(1), self._heights(elevation_map))

    def decide(
        self, frame: Tensor, elevation_map: Tensor, flag: Tensor, motion: Tensor, latent: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Raw current frame (N, F), elevation map (N, M) [m], flag (N, 1) and estimates to mean and gate."""
        current = self.normalizer(frame)
        inputs = [latent.detach(), motion.detach(), current, flag]
        if self.config.vision:
            inputs.append(self.map_encoder(self._heights(elevation_map), current))
        return self.head(torch.cat(inputs, dim=1))

    def forward(self, history: Tensor, elevation_map: Tensor, flag: Tensor) -> ActorOutput:
        """Raw history (N, H), elevation map (N, M) [m] and tracking flag (N, 1) to the policy's outputs."""
        motion, latent = self.encode(history, elevation_map)
        mean, gate = self.decide(history[:, -self.sizes.frame :], elevation_map, flag, motion, latent)
        return ActorOutput(mean, gate, motion, latent)

    def _heights(self, elevation_map: Tensor) -> Tensor:
        return (elevation_map - self.config.map_offset) * self.config.map_scale


def seen_by_critic(sizes: ObservationSizes, config: NetworkConfig) -> int:
    """Columns of the privileged observation that the critic sees: the map at its end only where the policy has one."""
    return sizes.privileged if config.vision else sizes.privileged - sizes.elevation_map


class Critic(nn.Module):
    """Value of the privileged state, with its own observation scaling."""

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig, command_columns: Tensor | None = None) -> None:
        """``command_columns`` (P,) bool: privileged columns that already have a fixed scale; default none."""
        super().__init__()
        self.seen = seen_by_critic(sizes, config)
        columns = None if command_columns is None else command_columns[: self.seen]
        self.normalizer = RunningNormalizer(self.seen, columns)
        self.hidden = perceptron(self.seen, config.critic_hidden, 1)[:-1]
        self.output = nn.Linear(config.critic_hidden[-1], 1)

    def forward(self, privileged: Tensor) -> Tensor:
        """Raw privileged observation (N, P) to values (N,)."""
        return self.output(self.hidden(self.normalized(privileged))).squeeze(1)

    def normalized(self, privileged: Tensor) -> Tensor:
        """The columns that the critic sees, normalized (N, seen)."""
        return self.normalizer(privileged[:, : self.seen])


class TargetEncoder(nn.Module):
    """Encodes the true next state for the contrastive loss and owns its prototypes; training only.

    Commands are hidden from it: the history contains them too, and a latent that merely copies them would
    already tell the samples of a batch apart. So are all other columns that are not normalized: posture reference and
    gait clock, which the history contains as well, the flag, the elevation map, which the map encoder is for, and the
    feet's contacts, of which it still sees the forces.
    """

    visible: Tensor

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig, command_columns: Tensor | None = None) -> None:
        """``command_columns`` (P,) bool: privileged columns to hide; default none."""
        super().__init__()
        seen = seen_by_critic(sizes, config)
        hidden = torch.zeros(seen) if command_columns is None else command_columns[:seen].detach().cpu()
        prototypes = torch.randn(config.prototypes, config.latent)
        self.layers = perceptron(seen, config.target_hidden, config.latent)
        self.prototypes = nn.Parameter(functional.normalize(prototypes, dim=1))
        self.register_buffer("visible", 1.0 - hidden.float())

    def forward(self, normalized_privileged: Tensor) -> Tensor:
        """Normalized next privileged observation (N, seen) to a unit latent (N, latent)."""
        return functional.normalize(self.layers(normalized_privileged * self.visible), dim=1)

    @torch.no_grad()
    def renormalize_prototypes(self) -> None:
        """Bring every prototype back to unit length."""
        self.prototypes.copy_(functional.normalize(self.prototypes, dim=1))
