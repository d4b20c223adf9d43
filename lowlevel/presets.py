"""Named training configurations. A preset is the default configuration with a few fields replaced."""

from __future__ import annotations

from dataclasses import replace

from lowlevel.environment import EnvironmentConfig
from lowlevel.networks import NetworkConfig
from lowlevel.nominal_config import NominalConfig
from lowlevel.rewards import PAPER_WEIGHTS
from lowlevel.terrain import TerrainConfig
from lowlevel.trainer import TrainingConfig

FLAT = TrainingConfig(network=NetworkConfig())


def _environment(**changes: object) -> EnvironmentConfig:
    return replace(FLAT.environment, **changes)  # type: ignore[arg-type]


SLABS = replace(FLAT, environment=_environment(terrain=TerrainConfig(tiles=("flat", "irregular"), tile_size=16.0)))

PRESETS: dict[str, TrainingConfig] = {
    # The shipped pilot-g1-simple. Blind, as the paper's row of that name: of slabs that differ by 2 cm, seen with 2 cm
    # of noise, the map told the policy nothing, and an update without it takes half the time.
    "simple": replace(SLABS, network=replace(SLABS.network, vision=False)),
    # The full network, and ablations of the paper; the one without vision is "simple"
    "slabs": SLABS,
    "no-attention": replace(SLABS, network=replace(SLABS.network, attention=False)),
    "no-moe": replace(SLABS, network=replace(SLABS.network, mixture=False)),
    # The full network on flat ground, and ablations of this implementation's additions
    "flat": FLAT,
    "no-balance": replace(FLAT, environment=_environment(nominal=NominalConfig(balance_stiffness=0.0))),
    "nominal-pose": replace(FLAT, environment=_environment(nominal=NominalConfig(kind="pose"))),
    "nominal-default": replace(FLAT, environment=_environment(nominal=NominalConfig(kind="default"))),
    "no-clock": replace(
        FLAT,
        environment=_environment(
            nominal=NominalConfig(kind="pose", gait_clock=False),
            rewards=replace(FLAT.environment.rewards, foot_phase=0.0),
        ),
    ),
    "paper-weights": replace(FLAT, environment=_environment(rewards=PAPER_WEIGHTS)),
    "soft-gains": replace(FLAT, environment=_environment(gains="soft")),
    "no-mirror": replace(FLAT, ppo=replace(FLAT.ppo, symmetry="none")),
}
"""Name to configuration, for ``train-lowlevel --preset``."""
