"""Holding torques of the arms against Pinocchio's generalized gravity."""

import numpy as np
import pinocchio as pin
import torch

from robots.g1.arm_mass import ArmMass
from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, TORSO_BODY, WAIST_JOINTS
from robots.g1.kinematics import build_model


def test_torques_hold_the_arms_as_in_pinocchio() -> None:
    model = build_model()
    data = model.createData()
    rng = np.random.default_rng(0)
    lower, upper = model.lowerPositionLimit[7:][ARM_JOINTS], model.upperPositionLimit[7:][ARM_JOINTS]
    arms, waist = rng.uniform(lower, upper, (50, 14)), rng.uniform(-0.5, 0.5, 3)
    expected = []
    for posture in arms:
        q = pin.neutral(model)
        q[7:] = DEFAULT_POSITION
        q[7:][WAIST_JOINTS], q[7:][ARM_JOINTS] = waist, posture
        expected.append(pin.computeGeneralizedGravity(model, data, q)[6:][ARM_JOINTS].copy())
    pin.framesForwardKinematics(model, data, q)
    torso = data.oMf[model.getFrameId(TORSO_BODY)].rotation
    gravity = torch.tensor(torso.T @ model.gravity.linear, dtype=torch.float32).expand(50, 3)
    torques = ArmMass().holding_torque(torch.tensor(arms, dtype=torch.float32), gravity)
    np.testing.assert_allclose(torques.numpy(), expected, atol=1e-4)
