"""What the nominal motion remembers from one control step to the next."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class NominalState(NamedTuple):
    """State of reference filter, gait clock and feedback; one row per robot."""

    reference: Tensor
    """Slewed command (N, 21)."""
    phase: Tensor
    """Gait phase (N,) [rad]; the left foot swings in (0, pi), the right one in (pi, 2 pi)."""
    walking: Tensor
    """Fade-in of the march (N,) in [0, 1]."""
    stopping: Tensor
    """Time for which a robot marches on after a command to stop (N,) [s]."""
    stepping: Tensor
    """Time for which a robot told to stand still marches to catch itself (N,) [s]."""
    settling: Tensor
    """Time for which a robot told to stand still keeps its posture (N,) [s]."""
    unbalance: Tensor
    """Tilt off the nominal attitude and off its own slow average, plus ``step_damping`` times the tilt rate off the
    nominal one (N,) [rad]: where the body is heading. Zero without the balance strategy."""
    gravity: Tensor
    """Filtered gravity direction in the pelvis frame (N, 3); zero until the first measurement."""
    tilt_rate: Tensor
    """Filtered angular velocity about x and y in the pelvis frame (N, 2) [rad/s]."""
    nominal_gravity: Tensor
    """Where gravity should point in the pelvis frame by now, as the pelvis lags behind its nominal attitude (N, 3);
    zero until the first step."""
    steady_tilt: Tensor
    """Slow average of the tilt about x and y (N, 2) [rad]."""
    acceleration: Tensor
    """Filtered acceleration of the velocity reference (N, 2), with that of turning [m/s^2]."""
    swing_trim: Tensor
    """Turn of the waist against the yaw rate in time with the gait: cosine and sine parts of its first three harmonics
    (N, 6) [rad]."""
    velocity_trim: Tensor
    """What the march adds to the velocity reference against a lasting error (N, 3) [m/s, m/s, rad/s]."""
    torso_trim: Tensor
    """What waist roll and pitch take up of a lasting torso error (N, 2) [rad]."""

    @classmethod
    def standing(cls, reference: Tensor, settling_time: float = 0.0) -> NominalState:
        """At rest at ``reference`` (N, 21), whose posture it keeps for ``settling_time`` [s] unless told to walk."""

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(len(reference), *shape, device=reference.device)

        return cls(
            reference=reference,
            phase=zeros(),
            walking=zeros(),
            stopping=zeros(),
            stepping=zeros(),
            settling=zeros() + settling_time,
            unbalance=zeros(),
            gravity=zeros(3),
            tilt_rate=zeros(2),
            nominal_gravity=zeros(3),
            steady_tilt=zeros(2),
            acceleration=zeros(2),
            swing_trim=zeros(6),
            velocity_trim=zeros(3),
            torso_trim=zeros(2),
        )
