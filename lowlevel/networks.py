"""The PILOT networks (paper, section III-B): history encoder, attention map encoder, mixture-of-experts actor, critic.

Tensors are batched along the first axis, N. Widths are small on purpose: the default policy trains on two CPU cores.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from lowlevel.normalizer import RunningNormalizer

MAP_SIDE = 11
"""Cells along each side of the elevation map."""
MAP_CELL = 0.1
"""Edge of a map cell [m]."""
VELOCITY_SIZE = 3


@dataclass(frozen=True)
class ObservationSizes:
    """Widths of the observation and action vectors."""

    frame: int
    """Numbers in one proprioceptive frame."""
    history_length: int
    """Past frames beside the current one."""
    elevation_map: int
    """Cells of the elevation map."""
    privileged: int
    """Numbers the critic sees; the first three are the base linear velocity [m/s]."""
    action: int
    """Joints that the policy drives."""

    @property
    def history(self) -> int:
        """Width of the flattened history: past frames, oldest first, then the current frame."""
        return (self.history_length + 1) * self.frame


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks, and the switches of the paper's ablations."""

    vision: bool = True
    """False: ablation "w/o vision"; the map is masked to zero and its encoding is a zero vector."""
    attention: bool = True
    """False: ablation "w/o attention-based encoder"; an MLP on the map gives the whole encoding."""
    mixture: bool = True
    """False: ablation "w/o MoE"; one monolithic MLP of about the same number of weights."""
    history_hidden: tuple[int, ...] = (128, 64)
    """Hidden widths of the history encoder."""
    latent: int = 32
    """Width of the predicted next-state latent."""
    map_offset: float = 0.0
    """Base height above the terrain that maps to zero [m]."""
    map_scale: float = 4.0
    """Scale of the elevation map after the offset [1/m]."""
    map_hidden: int = 64
    """Hidden width of the global map MLP and of the query MLP."""
    map_global: int = 32
    """Width of the global map feature."""
    pooling_windows: tuple[int, ...] = (1, 3, 5)
    """Edges of the average-pooling windows around each cell [cells, odd]."""
    token_features: int = 8
    """Features of the shared MLP per map cell."""
    attention_width: int = 32
    """Width of the attention encoding, all heads together."""
    attention_heads: int = 4
    """Attention heads."""
    experts: int = 4
    """Experts in the mixture."""
    expert_hidden: tuple[int, int] = (128, 96)
    """Hidden widths of each expert."""
    gate_hidden: int = 64
    """Hidden width of the gate."""
    monolithic_hidden: tuple[int, ...] = (384, 224)
    """Hidden widths of the single MLP that stands in for the mixture in the ablation."""
    critic_hidden: tuple[int, ...] = (256, 128)
    """Hidden widths of the critic."""
    target_hidden: tuple[int, ...] = (128, 64)
    """Hidden widths of the encoder of the next state (training only)."""
    prototypes: int = 64
    """Prototypes of the contrastive loss (training only)."""
    output_gain: float = 0.01
    """Gain of the last actor layer; small, so that the first actions are close to zero."""

    def __post_init__(self) -> None:
        if self.attention_width % self.attention_heads:
            raise ValueError(
                f"attention_width {self.attention_width} is not a multiple of {self.attention_heads} heads"
            )
        if any(window % 2 == 0 or window > MAP_SIDE for window in self.pooling_windows):
            raise ValueError(f"pooling windows must be odd and at most {MAP_SIDE}, not {self.pooling_windows}")


class ActorOutput(NamedTuple):
    """What the actor computes for N observations."""

    mean: Tensor
    """Mean action (N, A)."""
    gate: Tensor
    """Probability of each expert (N, E); ones (N, 1) for the monolithic ablation."""
    velocity: Tensor
    """Estimated base linear velocity (N, 3) [m/s], base frame."""
    latent: Tensor
    """Predicted latent of the next state (N, latent), unit length."""


def perceptron(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    """Linear layers with ELU between them and a linear output."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU(inplace=True)]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def small_output_(weight: Tensor, bias: Tensor, gain: float) -> None:
    """Make an output layer start near zero: orthogonal weight of the given gain, zero bias."""
    nn.init.orthogonal_(weight, gain)
    nn.init.zeros_(bias)


def without_autocast(values: Tensor) -> torch.autocast:
    """A context in which ``values``' device computes in full precision: output layers are never autocast."""
    return torch.autocast(values.device.type, enabled=False)


class HistoryEncoder(nn.Module):
    """History and map to base velocity and next-state latent (paper III-B-1; estimator of PIM, arXiv 2411.14386)."""

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig) -> None:
        super().__init__()
        outputs = VELOCITY_SIZE + config.latent
        self.layers = perceptron(sizes.history + sizes.elevation_map, config.history_hidden, outputs)

    def forward(self, history: Tensor, elevation_map: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised history (N, H) and map (N, M) to velocity (N, 3) [m/s] and unit latent (N, latent)."""
        outputs = self.layers(torch.cat([history, elevation_map], dim=1)).float()
        return outputs[:, :VELOCITY_SIZE], functional.normalize(outputs[:, VELOCITY_SIZE:], dim=1)


def pooling_matrix(windows: tuple[int, ...]) -> Tensor:
    """Average pooling of the map, one window per feature, as a matrix (M, len(windows) * M).

    ``map @ matrix`` lists, window by window, the mean around each cell; windows are cut at the border.
    """
    cells = MAP_SIDE * MAP_SIDE
    basis = torch.eye(cells).reshape(cells, 1, MAP_SIDE, MAP_SIDE)
    pooled = [
        functional.avg_pool2d(basis, window, stride=1, padding=window // 2, count_include_pad=False)
        for window in windows
    ]
    return torch.cat(pooled, dim=1).reshape(cells, -1)


def cell_coordinates() -> Tensor:
    """Position of each map cell relative to the base (2, M) in units of half the map's edge, x outer, y inner."""
    line = torch.linspace(-1.0, 1.0, MAP_SIDE)
    return torch.stack(torch.meshgrid(line, line, indexing="ij")).reshape(2, -1)


class MapEncoder(nn.Module):
    """Attention-based multi-scale map encoding (paper, equation 1).

    ``[global MLP(map) || MHA(query MLP(frame), tokens, tokens)]`` with one token per map cell:
    ``[shared MLP(average-pooled heights) || height || x, y]``. Two additions to the paper's text: the coordinates,
    as in He et al. (arXiv 2506.09588), without which attention could not tell one cell from another, and pooling over
    several windows, with which the shared MLP can see edges.

    There is one query, so the 121 tokens are never projected to keys and values. A head's score is
    ``q . (W_k f + b_k) = (W_k^T q) . f + const``, and its output ``sum p_i (W_v f_i + b_v) = W_v (sum p_i f_i) + b_v``:
    the query is projected through W_k once, and the tokens are pooled before W_v. The last layers of the query MLP and
    of the shared MLP are linear, so the former is W_q and the latter is part of W_k and W_v.

    Tokens are kept channels first and in two parts, because height and coordinates need no gradient: the encoder is
    bound by memory, not by arithmetic.
    """

    pooling: Tensor
    coordinates: Tensor

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig) -> None:
        """Build the encoder.

        Raises:
            ValueError: if the map is not 11 x 11.
        """
        super().__init__()
        if sizes.elevation_map != MAP_SIDE**2:
            raise ValueError(f"the elevation map must have {MAP_SIDE**2} cells, not {sizes.elevation_map}")
        self.heads = config.attention_heads
        self.features = config.token_features
        self.windows = len(config.pooling_windows)
        token = config.token_features + 3
        self.global_layers = perceptron(sizes.elevation_map, (config.map_hidden,), config.map_global)
        self.query_layers = perceptron(sizes.frame, (config.map_hidden,), config.attention_width)
        self.shared = nn.Linear(self.windows, config.token_features)
        self.key_weight = nn.Parameter(torch.empty(config.attention_width, token))
        self.value_weight = nn.Parameter(torch.empty(config.attention_width, token))
        self.value_bias = nn.Parameter(torch.zeros(config.attention_width))
        self.output = nn.Linear(config.attention_width, config.attention_width)
        nn.init.xavier_uniform_(self.key_weight)
        nn.init.xavier_uniform_(self.value_weight)
        self.register_buffer("pooling", pooling_matrix(config.pooling_windows), persistent=False)
        self.register_buffer("coordinates", cell_coordinates(), persistent=False)

    def tokens(self, elevation_map: Tensor) -> tuple[Tensor, Tensor]:
        """Local features of every cell: shared-MLP features (N, C, M), and height, x, y (N, 3, M)."""
        samples = len(elevation_map)
        pooled = (elevation_map @ self.pooling).unflatten(1, (self.windows, -1))
        weight = self.shared.weight.expand(samples, -1, -1)
        features = functional.elu(torch.baddbmm(self.shared.bias[:, None], weight, pooled))
        geometry = torch.cat([elevation_map.unsqueeze(1), self.coordinates.expand(samples, -1, -1)], dim=1)
        return features, geometry

    def attend(self, query: Tensor, features: Tensor, geometry: Tensor) -> Tensor:
        """Multi-head attention of one ``query`` (N, W) over the two parts of the tokens, giving (N, W)."""
        queries = query.unflatten(1, (self.heads, -1)).transpose(0, 1)
        key_weight = self.key_weight.unflatten(0, (self.heads, -1))
        projected = torch.bmm(queries, key_weight).transpose(0, 1) / math.sqrt(queries.shape[2])
        scores = torch.bmm(projected[:, :, self.features :], geometry)
        scores = torch.baddbmm(scores, projected[:, :, : self.features], features)
        weights = torch.softmax(scores, dim=-1)
        parts = [torch.bmm(weights, part.transpose(1, 2)) for part in (features, geometry)]
        pooled = torch.cat(parts, dim=2).transpose(0, 1)
        value_weight = self.value_weight.unflatten(0, (self.heads, -1))
        values = torch.bmm(pooled, value_weight.transpose(1, 2)).transpose(0, 1)
        return self.output(values.flatten(1) + self.value_bias)

    def forward(self, elevation_map: Tensor, frame: Tensor) -> Tensor:
        """Scaled map (N, M) and normalised current frame (N, F) to the encoding (N, map_global + attention_width)."""
        attended = self.attend(self.query_layers(frame), *self.tokens(elevation_map))
        return torch.cat([functional.elu(self.global_layers(elevation_map)), attended], dim=1)


class PlainMapEncoder(nn.Module):
    """The ablation "w/o attention-based encoder": one MLP on the map, as wide as the full encoding."""

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig) -> None:
        super().__init__()
        outputs = config.map_global + config.attention_width
        self.layers = perceptron(sizes.elevation_map, (2 * config.map_hidden,), outputs)

    def forward(self, elevation_map: Tensor, frame: Tensor) -> Tensor:
        """Scaled map (N, M) to the encoding; the frame is not used."""
        return functional.elu(self.layers(elevation_map))


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
        with without_autocast(hidden):
            return torch.baddbmm(self.output_bias, hidden.float(), self.output_weight)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """``inputs`` (N, inputs) to the blended action (N, outputs) and gate probabilities (N, E)."""
        gate = torch.softmax(self.gate_layers(inputs).float(), dim=1)
        return (gate.T.unsqueeze(-1) * self.proposals(inputs)).sum(dim=0), gate


class MonolithicActor(nn.Module):
    """The ablation "w/o MoE": one MLP."""

    def __init__(self, inputs: int, outputs: int, config: NetworkConfig) -> None:
        super().__init__()
        self.hidden = nn.Sequential(*perceptron(inputs, config.monolithic_hidden, 1)[:-1])
        self.output = nn.Linear(config.monolithic_hidden[-1], outputs)
        small_output_(self.output.weight, self.output.bias, config.output_gain)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """``inputs`` (N, inputs) to the action (N, outputs) and a gate of ones (N, 1)."""
        hidden = self.hidden(inputs).float()
        with without_autocast(hidden):
            return self.output(hidden), torch.ones_like(hidden[:, :1])


class PilotActor(nn.Module):
    """The policy: history encoder, map encoder and mixture of experts, with its own observation scaling.

    Velocity and latent enter the policy detached, as in the HIM family of estimators: no policy gradient reaches the
    history encoder, which learns from its own loss (:mod:`lowlevel.estimation`). The exploration noise is one
    ``log_std`` per action, independent of the state.
    """

    def __init__(
        self, sizes: ObservationSizes, config: NetworkConfig, command_columns: Tensor, initial_std: float = 0.5
    ) -> None:
        """``command_columns`` (F,) bool: frame columns that already have a fixed scale and are not normalised."""
        super().__init__()
        self.sizes = sizes
        self.config = config
        self.normalizer = RunningNormalizer(sizes.frame, command_columns)
        self.history_encoder = HistoryEncoder(sizes, config)
        encoder = MapEncoder if config.attention else PlainMapEncoder
        self.map_encoder = encoder(sizes, config).requires_grad_(config.vision)
        self.perception_size = config.map_global + config.attention_width
        inputs = self.perception_size + config.latent + VELOCITY_SIZE + sizes.frame + 1
        head = MixtureOfExperts if config.mixture else MonolithicActor
        self.head = head(inputs, sizes.action, config)
        self.log_std = nn.Parameter(torch.full((sizes.action,), math.log(initial_std)))

    def estimator_parameters(self) -> list[nn.Parameter]:
        """Parameters of the history encoder."""
        return list(self.history_encoder.parameters())

    def policy_parameters(self) -> list[nn.Parameter]:
        """Parameters that the policy gradient trains."""
        estimator = {id(parameter) for parameter in self.estimator_parameters()}
        return [p for p in self.parameters() if p.requires_grad and id(p) not in estimator]

    def forward(self, history: Tensor, elevation_map: Tensor, flag: Tensor) -> ActorOutput:
        """Raw history (N, H), elevation map (N, M) [m] and tracking flag (N, 1) to the policy's outputs."""
        frames = self.normalizer(history.unflatten(1, (-1, self.sizes.frame)))
        heights = (elevation_map - self.config.map_offset) * self.config.map_scale
        if not self.config.vision:
            heights = torch.zeros_like(heights)
        velocity, latent = self.history_encoder(frames.flatten(1), heights)
        current = frames[:, -1]
        if self.config.vision:
            perception = self.map_encoder(heights, current)
        else:
            perception = current.new_zeros(len(current), self.perception_size)
        mean, gate = self.head(torch.cat([perception, latent.detach(), velocity.detach(), current, flag], dim=1))
        return ActorOutput(mean, gate, velocity, latent)


class Critic(nn.Module):
    """Value of the privileged state, with its own observation scaling."""

    def __init__(
        self, sizes: ObservationSizes, config: NetworkConfig, command_columns: Tensor | None = None
    ) -> None:
        """``command_columns`` (P,) bool: privileged columns that already have a fixed scale; default none."""
        super().__init__()
        self.normalizer = RunningNormalizer(sizes.privileged, command_columns)
        layers = perceptron(sizes.privileged, config.critic_hidden, 1)
        self.hidden = layers[:-1]
        self.output = nn.Linear(config.critic_hidden[-1], 1)

    def forward(self, privileged: Tensor) -> Tensor:
        """Raw privileged observation (N, P) to values (N,)."""
        hidden = self.hidden(self.normalizer(privileged)).float()
        with without_autocast(hidden):
            return self.output(hidden).squeeze(1)


class TargetEncoder(nn.Module):
    """Encodes the true next state for the contrastive loss and owns its prototypes; training only.

    ``visible`` (P,) bool masks the privileged columns it may see. Commands should be hidden: the history contains
    them too, and a latent that merely copies them would already tell the samples of a batch apart.
    """

    visible: Tensor

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig, visible: Tensor | None = None) -> None:
        super().__init__()
        visible = torch.ones(sizes.privileged) if visible is None else visible.detach().float()
        self.layers = perceptron(sizes.privileged, config.target_hidden, config.latent)
        self.prototypes = nn.Parameter(functional.normalize(torch.randn(config.prototypes, config.latent), dim=1))
        self.register_buffer("visible", visible)

    def forward(self, normalised_privileged: Tensor) -> Tensor:
        """Normalised next privileged observation (N, P) to a unit latent (N, latent)."""
        return functional.normalize(self.layers(normalised_privileged * self.visible).float(), dim=1)

    @torch.no_grad()
    def renormalise_prototypes(self) -> None:
        """Bring every prototype back to unit length."""
        self.prototypes.copy_(functional.normalize(self.prototypes, dim=1))
