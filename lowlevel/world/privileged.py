"""What the critic sees, and how every vector that the networks see is mirrored."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from lowlevel.control.elevation_map import MAP_MIRROR
from lowlevel.control.observation import FRAME, FRAME_MIRROR, HISTORY_LENGTH, Block, FrameView
from lowlevel.world.measures import Measurement, height_error, torso_error
from lowlevel.world.randomization import RandomizationState
from robots.g1.mirror import AXIAL_VECTOR, JOINTS_MIRROR, PAIR, PAIR_OF_VECTORS, VECTOR, Mirror, concatenate, signs


@dataclass(frozen=True)
class PrivilegedView(FrameView):
    """What the critic's observation of N robots is read from; its proprioception is exact."""

    measured: Measurement
    elevation: Tensor
    """Elevation map without noise, as observed (N, 121) [m]."""
    mean_velocity_error: Tensor
    """Running mean (N, 3) [m/s, m/s, rad/s]."""
    hand_force: Tensor
    """On each hand (N, 2, 3) [N], heading frame."""
    flag: Tensor
    """Tracking flag I (N, 1)."""
    drawn: RandomizationState


PRIVILEGED: tuple[Block[PrivilegedView], ...] = (
    Block("base_linear_velocity", VECTOR, lambda v: v.measured.linear_velocity),
    Block("capture_point", signs(1, -1), lambda v: v.measured.capture_point),
    *FRAME,
    Block("base_height_error", signs(1), lambda v: height_error(v.measured, v.command)[:, None]),
    Block("torso_error", AXIAL_VECTOR, lambda v: torso_error(v.measured, v.command)),
    Block("mean_velocity_error", signs(1, -1, -1), lambda v: v.mean_velocity_error),
    Block("foot_contact", PAIR, lambda v: v.measured.foot_contact.float(), normalized=False),
    Block("foot_clearance", PAIR, lambda v: v.measured.foot_clearance),
    Block("foot_position", PAIR_OF_VECTORS, lambda v: v.measured.foot_position.flatten(1)),
    Block("foot_velocity", PAIR_OF_VECTORS, lambda v: v.measured.foot_velocity.flatten(1)),
    Block("foot_force", PAIR_OF_VECTORS, lambda v: v.measured.foot_force.flatten(1) / 400.0),
    Block("hand_force", PAIR_OF_VECTORS, lambda v: v.hand_force.flatten(1) / 20.0),
    Block("friction", signs(1), lambda v: v.drawn.friction),
    Block("added_mass", signs(1, 1), lambda v: v.drawn.added_mass),
    Block("flag", signs(1), lambda v: v.flag, normalized=False),
    Block("elevation_map", MAP_MIRROR, lambda v: v.elevation, normalized=False),
)
"""What the critic sees, noise-free. First comes what the policy's history encoder estimates."""
PRIVILEGED_SIZE = sum(block.size for block in PRIVILEGED)

MIRRORS: dict[str, Mirror] = {
    "history": FRAME_MIRROR.repeated(HISTORY_LENGTH + 1),
    "elevation_map": MAP_MIRROR,
    "privileged": concatenate(*(block.mirror for block in PRIVILEGED)),
    "action": JOINTS_MIRROR,
}
