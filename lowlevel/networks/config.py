"""Sizes of the observations and of the networks, and the layer stack that all networks are made of."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn

from robots.errors import PilotError


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
    """Numbers the critic sees; the first five are what the history encoder estimates: velocity [m/s] and capture point
    [m]."""
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
    """False: ablation "w/o vision"; neither the map nor its encoding is an input of any network."""
    attention: bool = True
    """False: ablation "w/o attention-based encoder"; an MLP on the map gives the whole encoding."""
    mixture: bool = True
    """False: ablation "w/o MoE"; one monolithic MLP of about the same number of weights."""
    history_hidden: tuple[int, ...] = (128, 64)
    """Hidden widths of the history encoder."""
    latent: int = 32
    """Width of the predicted next-state latent."""
    map_offset: float = 0.0
    """Entry of the observed elevation map that the networks see as zero [m]."""
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
            raise PilotError(
                f"attention_width {self.attention_width} is not a multiple of {self.attention_heads} heads"
            )
        if any(window % 2 == 0 for window in self.pooling_windows):
            raise PilotError(f"pooling windows must be odd, not {self.pooling_windows}")


def perceptron(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    """Linear layers with ELU between them and a linear output."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ELU(inplace=True)]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))
