"""First moment of the arms against Pinocchio's centre of mass."""

import numpy as np
import pinocchio as pin
import torch

from robots.g1.arm_mass import ArmMass
from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, TORSO_BODY, WAIST_JOINTS
from robots.g1.kinematics import build_model


def test_first_moment_moves_the_centre_of_mass_as_in_pinocchio() -> None:
    model = build_model()
    data = model.createData()
    rng = np.random.default_rng(0)
    lower, upper = model.lowerPositionLimit[7:][ARM_JOINTS], model.upperPositionLimit[7:][ARM_JOINTS]
    arms = rng.uniform(lower, upper, (50, 14))
    moments = ArmMass().first_moment(torch.tensor(arms, dtype=torch.float32)).double().numpy()
    total = sum(inertia.mass for inertia in model.inertias)
    waist = rng.uniform(-0.5, 0.5, 3)
    centers = []
    for posture in arms:
        q = pin.neutral(model)
        q[7:] = DEFAULT_POSITION
        q[7:][WAIST_JOINTS], q[7:][ARM_JOINTS] = waist, posture
        centers.append(pin.centerOfMass(model, data, q).copy())
        pin.updateFramePlacements(model, data)
    torso = data.oMf[model.getFrameId(TORSO_BODY)].rotation
    moved = total * (np.array(centers[1:]) - centers[0])
    np.testing.assert_allclose((moments[1:] - moments[0]) @ torso.T, moved, atol=1e-5)
