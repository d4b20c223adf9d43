"""Conditions over which lift-box is mapped: what the box is like, where it is, and what disturbs the robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from highlevel.task import Sweep, SweepAxis
from tasks.lift_box.config import LiftBoxConfig, NoiseConfig, PushConfig


def _spawn(name: str) -> Callable[[LiftBoxConfig, float], LiftBoxConfig]:
    """Fixes a range of :class:`SpawnConfig`."""

    def fix(config: LiftBoxConfig, value: float) -> LiftBoxConfig:
        # mypy cannot follow a field named at run time.
        return replace(config, spawn=replace(config.spawn, **{name: (value, value)}))  # type: ignore[arg-type]

    return fix


def _support(config: LiftBoxConfig, height: float) -> LiftBoxConfig:
    spawn = replace(config.spawn, floor_share=float(height == 0.0), support_height=(height, height))
    return replace(config, spawn=spawn)


def _pose_noise(config: LiftBoxConfig, factor: float) -> LiftBoxConfig:
    usual = NoiseConfig()
    return replace(config, noise=NoiseConfig(factor * usual.position, factor * usual.angle))


def _push(config: LiftBoxConfig, velocity: float) -> LiftBoxConfig:
    return replace(config, push=PushConfig(velocity))


_MASS = SweepAxis("mass [kg]", (0.5, 1.0, 2.0, 3.0), _spawn("mass"))

SWEEPS = (
    Sweep("mass_edge", _MASS, SweepAxis("edge [m]", (0.25, 0.30, 0.35), _spawn("edge"))),
    Sweep("friction_mass", SweepAxis("friction", (0.3, 0.5, 0.8, 1.2), _spawn("friction")), _MASS),
    Sweep(
        "distance_bearing",
        SweepAxis("distance [m]", (0.8, 1.4, 2.0), _spawn("distance")),
        SweepAxis("bearing [rad]", (-0.785, 0.0, 0.785), _spawn("bearing")),
    ),
    Sweep("support_height", SweepAxis("support [m]", (0.0, 0.15, 0.35), _support)),
    Sweep("pose_noise", SweepAxis("times the usual pose noise", (0.0, 1.0, 2.0, 4.0), _pose_noise)),
    Sweep("push", SweepAxis("pushes every 3 s [m/s]", (0.1, 0.2, 0.3, 0.5), _push)),
)
"""A few values lie beyond what planners are trained on: 3 kg, friction 0.3, a support of 0.35 m, noise, pushes."""
