"""What the low-level environment remembers about its robots between steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.control.observation import FRAME_SIZE, HISTORY_LENGTH
from lowlevel.control.reference import ReferenceState
from lowlevel.world.randomization import MOST_MAP_DELAY
from robots.g1.constants import NUM_JOINTS


@dataclass
class Buffers:
    """Per-robot tensors that live across steps; with the simulation's state they are the whole environment."""

    command: Tensor
    kind: Tensor
    flag: Tensor
    command_countdown: Tensor
    episode_step: Tensor
    action: Tensor
    previous_action: Tensor
    reference: ReferenceState
    history: Tensor
    maps: Tensor
    """The elevation maps taken last, the newest first (N, MOST_MAP_DELAY + 1, 121)."""
    foot_air_time: Tensor
    foot_contact_time: Tensor
    hand_force: Tensor
    mean_velocity_error: Tensor
    capture_point: Tensor
    tile_kind: Tensor
    tile: Tensor
    velocity_error_sum: Tensor
    """Norm of the mean velocity error, summed over the steps of the episode."""
    ground: Tensor
    """Height of the ground below the base [m]."""
    climbed: Tensor
    """How much it has changed in the episode, up and down together [m]."""

    @classmethod
    def empty(cls, neutral: Tensor) -> Buffers:
        """Buffers of robots that stand under the ``neutral`` command (N, 21)."""
        n = len(neutral)

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(n, *shape, device=neutral.device)

        return cls(
            command=neutral,
            kind=torch.zeros(n, dtype=torch.long, device=neutral.device),
            flag=zeros(1),
            command_countdown=zeros(),
            episode_step=torch.zeros(n, dtype=torch.long, device=neutral.device),
            action=zeros(NUM_JOINTS),
            previous_action=zeros(NUM_JOINTS),
            reference=ReferenceState.standing(neutral.clone()),
            history=zeros(HISTORY_LENGTH + 1, FRAME_SIZE),
            maps=zeros(MOST_MAP_DELAY + 1, MAP_SIZE),
            foot_air_time=zeros(2),
            foot_contact_time=zeros(2),
            hand_force=zeros(2, 3),
            mean_velocity_error=zeros(3),
            capture_point=zeros(2),
            tile_kind=torch.zeros(n, dtype=torch.long, device=neutral.device),
            tile=torch.zeros(n, dtype=torch.long, device=neutral.device),
            velocity_error_sum=zeros(),
            ground=zeros(),
            climbed=zeros(),
        )
