"""Fixtures that several folders share."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from some_correction import fill

from highlevel.pictures.painter import NoOpenGLError, find_platform
from lowlevel.commands import command_space
from lowlevel.control.controller import ControllerConfig, PolicyConfig, actor_sizes, build_step, save_controller
from lowlevel.control.observation import FRAME, normalized_columns
from lowlevel.control.reference import ReferenceConfig
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.networks.actor import NetworkConfig, PilotActor
from robots.g1.constants import DEFAULT_POSITION, GAINS, JOINT_NAMES
from robots.g1.model import build_spec, joint_limits
from robots.g1.nominal_pose import NominalPose

# Matrices are small here, and idle threads that spin slow everything down several-fold on a busy machine.
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def has_opengl() -> bool:
    """Whether this machine can render pictures."""
    try:
        find_platform()
    except NoOpenGLError:
        return False
    return True


@pytest.fixture(scope="session")
def untrained_controller(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a controller with random weights: it falls, but everything around it can be exercised."""
    torch.manual_seed(0)
    gains, limits = GAINS["stiff"], joint_limits(build_spec().compile())
    pose, network = NominalPose.load(), NetworkConfig()
    config = ControllerConfig(
        joint_names=JOINT_NAMES,
        default_position=tuple(DEFAULT_POSITION.tolist()),
        joint_lower=tuple(limits[:, 0].tolist()),
        joint_upper=tuple(limits[:, 1].tolist()),
        stiffness=tuple(gains.stiffness.tolist()),
        damping=tuple(gains.damping.tolist()),
        action_scale=tuple(gains.action_scale.tolist()),
        action_limit=8.0,
        control_period=0.02,
        command_space=command_space(limits[:, 0].tolist(), limits[:, 1].tolist()),
    )
    policy = PolicyConfig(ReferenceConfig(), network, pose.axes)
    actor = PilotActor(actor_sizes(), network, ~normalized_columns(FRAME))
    correction = fill(VelocityCorrection(config.command_space))
    folder = tmp_path_factory.mktemp("controllers") / "untrained"
    save_controller(folder, config, policy, build_step(config, policy, actor, correction, pose, "cpu"), provenance={})
    return folder
