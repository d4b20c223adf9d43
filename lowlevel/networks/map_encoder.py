"""The attention-based map encoder (paper III-B-1, equation 1) and the plain MLP of its ablation."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from lowlevel.networks.config import NetworkConfig, ObservationSizes, perceptron
from robots.errors import PilotError


def pooling_matrix(side: int, windows: tuple[int, ...]) -> Tensor:
    """Average pooling of a map of ``side`` x ``side`` = M cells as a matrix (M, len(windows) * M).

    ``map @ matrix`` lists, window by window, the mean around each cell; windows are cut at the border.
    """
    basis = torch.eye(side * side).reshape(side * side, 1, side, side)
    pooled = [
        functional.avg_pool2d(basis, window, stride=1, padding=window // 2, count_include_pad=False)
        for window in windows
    ]
    return torch.cat(pooled, dim=1).reshape(side * side, -1)


def cell_coordinates(side: int) -> Tensor:
    """Position of each cell relative to the base (2, M), in half map edges; x is the outer index."""
    line = torch.linspace(-1.0, 1.0, side)
    return torch.stack(torch.meshgrid(line, line, indexing="ij")).reshape(2, -1)


class MapEncoder(nn.Module):
    """Attention-based multi-scale map encoding (paper, equation 1).

    ``[global MLP(map) || MHA(query MLP(frame), tokens, tokens)]`` with one token per map cell,
    ``[shared MLP(average-pooled heights) || height || x, y]``. Two additions to the paper's text: the
    coordinates, as in He et al. (arXiv 2506.09588), without which attention could not tell one cell from
    another, and pooling over several windows, with which the shared MLP can see edges.

    There is one query, so the 121 tokens are never projected to keys and values. A head's score is
    ``q . (W_k f + b_k) = (W_k^T q) . f + const`` and its output is
    ``sum p_i (W_v f_i + b_v) = W_v (sum p_i f_i) + b_v``: the query goes through W_k once, and the tokens are
    pooled before W_v. The last layers of the query MLP and of the shared MLP are linear, so the former is W_q
    and the latter is part of W_k and W_v.

    Tokens are kept channels first and in two parts, because height and coordinates need no gradient: the
    encoder is bound by memory, not by arithmetic.
    """

    pooling: Tensor
    coordinates: Tensor

    def __init__(self, sizes: ObservationSizes, config: NetworkConfig) -> None:
        """Build the encoder.

        Raises:
            PilotError: if the map is not a square, or smaller than a pooling window.
        """
        super().__init__()
        side = math.isqrt(sizes.elevation_map)
        if side * side != sizes.elevation_map or max(config.pooling_windows) > side:
            raise PilotError(f"windows {config.pooling_windows} do not fit a map of {sizes.elevation_map} cells")
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
        self.register_buffer("pooling", pooling_matrix(side, config.pooling_windows), persistent=False)
        self.register_buffer("coordinates", cell_coordinates(side), persistent=False)

    def tokens(self, elevation_map: Tensor) -> tuple[Tensor, Tensor]:
        """Local features of every cell: shared-MLP features (N, C, M), and height, x, y (N, 3, M)."""
        samples = elevation_map.shape[0]
        pooled = (elevation_map @ self.pooling).unflatten(1, (self.windows, -1))
        weight = self.shared.weight.expand(samples, -1, -1)
        features = functional.elu(torch.baddbmm(self.shared.bias[:, None], weight, pooled), inplace=True)
        geometry = torch.cat([elevation_map.unsqueeze(1), self.coordinates.expand(samples, -1, -1)], dim=1)
        return features, geometry

    def attend(self, query: Tensor, features: Tensor, geometry: Tensor) -> Tensor:
        """Multi-head attention of one ``query`` (N, W) over the two parts of the tokens, giving (N, W)."""
        queries = query.unflatten(1, (self.heads, -1)).transpose(0, 1)
        key_weight = self.key_weight.unflatten(0, (self.heads, -1))
        projected = torch.bmm(queries, key_weight).transpose(0, 1) / math.sqrt(queries.shape[2])
        scores = torch.bmm(projected[:, :, self.features :], geometry)
        scores = torch.baddbmm(scores, projected[:, :, : self.features], features)
        weights = torch.softmax(scores, dim=-1).transpose(1, 2)
        pooled = torch.cat([torch.bmm(part, weights) for part in (features, geometry)], dim=1).permute(2, 0, 1)
        value_weight = self.value_weight.unflatten(0, (self.heads, -1))
        values = torch.bmm(pooled, value_weight.transpose(1, 2)).transpose(0, 1)
        return self.output(values.flatten(1) + self.value_bias)

    def forward(self, elevation_map: Tensor, frame: Tensor) -> Tensor:
        """Scaled map (N, M) and normalized frame (N, F) to the encoding (N, map_global + attention_width)."""
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
