"""The tracking protocol: which episodes are run, and what is added up over them.

Episodes last 20 s with a new command every 10 s from a fixed mixture, without pushes, with observation noise,
friction 0.6 to 1.0 and physics at 2 ms. An episode that ends in a fall counts in full, at the mean error it
had until then. Beside the tracking errors stand what walking costs and how fast the joint targets move.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from evaluation.harness import Arena, Episode, Moment, constant, episode_seeds, run_all
from evaluation.statistics import Figure, mean_figure, share_figure
from lowlevel.commands import (
    ARMS,
    HEIGHT,
    STANDING_SPEED,
    TORSO,
    VELOCITY,
    CommandMixture,
    CommandRange,
    CommandSampler,
    CommandSpace,
    is_walking,
)
from lowlevel.measures import TRACKING_FIGURES
from lowlevel.terrain import TerrainConfig

EPISODE_LENGTH = 20.0
"""[s]"""
COMMAND_INTERVAL = 10.0
"""[s]"""
TRANSIENT = 2.0
"""Time after a change of command that steady figures leave out [s]."""
TILE_SIZE = 16.0
"""Side of a tile [m]: wide enough that walking robots rarely leave it."""

SUITES: dict[str, tuple[str, ...]] = {
    "simple": ("flat", "irregular"),
}
"""Terrain tiles of each suite, in equal shares."""

GROUPS = ("walk_and_work", "stand_and_work", "walk_only")
"""Groups of commands: locomotion with posture and arms, posture and arms alone, locomotion alone (I = 0)."""

WALK_SPEED = 0.5
"""Forward speed of the walking test [m/s]."""
WALK_TIME = 10.0
"""[s]"""
WALK_EPISODES = 100
MODE_EPISODES = 5
"""Episodes of each motion mode."""
MODE_TIME = 6.0
"""Length of a motion-mode episode [s]."""


def suite_terrain(suite: str) -> TerrainConfig:
    """The terrain of a suite.

    Raises:
        ValueError: if there is no such suite.
    """
    if suite not in SUITES:
        raise ValueError(f"unknown suite {suite!r}; choose one of {', '.join(SUITES)}")
    return TerrainConfig(tiles=SUITES[suite], tile_size=TILE_SIZE)


def protocol_episodes(
    space: CommandSpace, count: int, seed: int, tiles: int, duration: float = EPISODE_LENGTH
) -> list[Episode]:
    """The fixed episodes of an evaluation: episode i is the same for every controller and ``count``."""
    sampler = CommandSampler(space, CommandMixture())
    starts = tuple(np.arange(0.0, duration, COMMAND_INTERVAL).tolist())
    episodes = []
    for index in range(count):
        command_seed, world_seed = episode_seeds(seed, index)
        generator = torch.Generator().manual_seed(command_seed)
        commands, flags = sampler.sample(len(starts), CommandRange(), generator)
        episodes.append(Episode(world_seed, duration, starts, commands, flags[:, 0], index % tiles))
    return episodes


def group_of(command: Tensor, flag: Tensor) -> Tensor:
    """Index into :data:`GROUPS` (N,) of commands (N, 21) with flags (N, 1)."""
    works = torch.where(is_walking(command), 0, 1)
    return torch.where(flag[:, 0] > 0.5, works, 2)


@dataclass(frozen=True)
class TrackingResult:
    """Episode means of every figure; NaN where an episode has no such step."""

    errors: dict[str, np.ndarray]
    """Category -> (episodes, figures), in the order of TRACKING_FIGURES."""
    falls: dict[str, np.ndarray]
    """Category -> 1 for a fall, 0 for none, NaN for no such step (episodes,)."""
    transient: np.ndarray
    """Mean figures over the time since the command changed (steps, figures)."""
    energy: np.ndarray
    """Mechanical work, both signs counted positive, on commands to travel (episodes,) [J]."""
    progress: np.ndarray
    """Way made good in the commanded directions on the same steps (episodes,) [m]."""
    action_rate: np.ndarray
    """Mean change of a joint's target from one control step to the next (episodes,) [rad]."""
    tiles: np.ndarray
    """Tile that each episode started on (episodes,)."""


CATEGORIES = ("all", *GROUPS)


def travel_effort(moment: Moment) -> tuple[Tensor, Tensor]:
    """Power sum |torque * joint speed| (N,) [W] and speed in the commanded direction (N,) [m/s].

    Both are zero where the episode is over or the command asks for no translation: turning on the spot gets nowhere.
    """
    robot, wanted = moment.measured.robot, moment.command[:, VELOCITY][:, :2]
    speed = wanted.norm(dim=-1)
    counted = moment.active & (speed >= STANDING_SPEED)
    power = (robot.joint_torque * robot.joint_velocity).abs().sum(-1)
    made_good = (moment.measured.linear_velocity[:, :2] * wanted).sum(-1) / speed.clamp_min(STANDING_SPEED)
    return torch.where(counted, power, 0.0), torch.where(counted, made_good, 0.0)


def run_tracking(
    arena: Arena, episodes: Sequence[Episode], advance: Callable[[int], None] = lambda steps: None
) -> TrackingResult:
    """Run ``episodes`` and reduce them to one row each."""
    bins = round(COMMAND_INTERVAL / arena.period)
    names = [*CATEGORIES, *(f"{name}_steady" for name in CATEGORIES)]
    sums = np.zeros((len(names), len(episodes), len(TRACKING_FIGURES)))
    counts = np.zeros((len(names), len(episodes)))
    falls = np.zeros((len(names), len(episodes)))
    transient_sums, transient_counts = np.zeros((bins, len(TRACKING_FIGURES))), np.zeros(bins)
    energy, progress = np.zeros(len(episodes)), np.zeros(len(episodes))
    changes, change_counts = np.zeros(len(episodes)), np.zeros(len(episodes))

    def observe(first: int, batch: Sequence[Episode]) -> Callable[[Moment], None]:
        rows = slice(first, first + len(batch))
        previous_targets: Tensor | None = None

        def add(moment: Moment) -> None:
            nonlocal previous_targets
            power, speed = (value.numpy()[: len(batch)].astype(float) for value in travel_effort(moment))
            energy[rows] += power * arena.period
            progress[rows] += speed * arena.period
            if previous_targets is not None:
                change = (moment.targets - previous_targets).abs().mean(dim=-1)
                changes[rows] += torch.where(moment.active, change, 0.0).numpy()[: len(batch)]
                change_counts[rows] += moment.active.numpy()[: len(batch)]
            previous_targets = moment.targets
            errors = torch.stack(
                [function(moment.measured, moment.command) for _, function in TRACKING_FIGURES.values()], -1
            )
            errors = torch.where(moment.active[:, None], errors, 0.0)
            group = group_of(moment.command, moment.flag)
            members = torch.stack([moment.active, *(moment.active & (group == g) for g in range(len(GROUPS)))])
            is_steady = moment.since_change > TRANSIENT
            masks = torch.cat([members, members & is_steady])
            weights = masks.numpy()[:, : len(batch)]
            values = errors.numpy()[: len(batch)].astype(float)
            sums[:, rows] += weights[:, :, None] * values
            counts[:, rows] += weights
            falls[:, rows] += (masks & moment.fell).numpy()[:, : len(batch)]
            slot = torch.round(moment.since_change / arena.period).long().numpy()[: len(batch)] - 1
            inside = weights[0] & (slot < bins)
            np.add.at(transient_sums, slot[inside], values[inside])
            np.add.at(transient_counts, slot[inside], 1.0)

        return add

    run_all(arena, episodes, observe, advance)
    with np.errstate(invalid="ignore"):
        means = sums / counts[:, :, None]
        fell = np.where(counts > 0, falls, np.nan)
        transient = transient_sums / transient_counts[:, None]
        action_rate = changes / change_counts
    tiles = np.array([episode.tile for episode in episodes])
    return TrackingResult(
        errors=dict(zip(names, means, strict=True)),
        falls=dict(zip(names, fell, strict=True)),
        transient=transient,
        energy=energy,
        progress=progress,
        action_rate=action_rate,
        tiles=tiles,
    )


def tracking_figures(result: TrackingResult, tile_names: Sequence[str]) -> dict[str, Figure]:
    """Figures by name: ``E_v``, ``E_v_steady``, ``E_v_walk_only`` and so on, fall rates, and what walking costs."""
    figures = {}
    for category in ("all", "all_steady", *GROUPS, *(f"{group}_steady" for group in GROUPS)):
        suffix = category.removeprefix("all").removeprefix("_")
        for column, (name, (unit, _)) in enumerate(TRACKING_FIGURES.items()):
            figures[_join(name, suffix)] = mean_figure(result.errors[category][:, column], unit)
        fell = result.falls[category]
        figures[_join("fall_rate", suffix)] = share_figure(fell[~np.isnan(fell)] > 0)
    for tile, tile_name in enumerate(tile_names):
        rows = result.tiles == tile
        for column, (name, (unit, _)) in enumerate(TRACKING_FIGURES.items()):
            figures[f"{name}_on_{tile_name}"] = mean_figure(result.errors["all"][rows, column], unit)
        figures[f"fall_rate_on_{tile_name}"] = share_figure(result.falls["all"][rows] > 0)
    figures["energy_per_metre"] = energy_per_metre(result.energy, result.progress)
    figures["action_rate"] = mean_figure(result.action_rate, "rad")
    return figures


def energy_per_metre(energy: np.ndarray, progress: np.ndarray) -> Figure:
    """All work over all way made good [J/m], from episodes' ``energy`` [J] and ``progress`` [m]; both (episodes,).

    Single episodes give no usable ratio: one that only staggers on the spot has made no way. The ratio of the sums is
    the mean of its own linearisation, one number per episode, which gives the interval.
    """
    travelled = energy > 0.0
    energy, progress = energy[travelled], progress[travelled]
    if progress.sum() <= 0.0:
        return Figure(None, "J/m", None, 0)
    ratio = energy.sum() / progress.sum()
    return mean_figure(ratio + (energy - ratio * progress) / progress.mean(), "J/m")


def _join(name: str, suffix: str) -> str:
    return f"{name}_{suffix}" if suffix else name


# -- walking at one speed ------------------------------------------------------------------------------------


def walking_episodes(space: CommandSpace, count: int, seed: int, tiles: int) -> list[Episode]:
    """Walk straight ahead upright at WALK_SPEED, arms at their default."""
    command = space.neutral()
    command[VELOCITY.start] = WALK_SPEED
    return [
        constant(episode_seeds(seed, index)[1], WALK_TIME, command, flag=1.0, tile=index % tiles)
        for index in range(count)
    ]


def run_walking(
    arena: Arena, episodes: Sequence[Episode], advance: Callable[[int], None] = lambda steps: None
) -> dict[str, Figure]:
    """``walk_half_mps_survival`` (no fall), ``…_speed`` (forward, until the end) and ``…_success`` (both).

    Success is no fall and at least half the commanded speed on average: standing still is not walking.
    """
    sums, counts = torch.zeros(len(episodes)), torch.zeros(len(episodes))
    fell = torch.zeros(len(episodes), dtype=torch.bool)

    def observe(first: int, batch: Sequence[Episode]) -> Callable[[Moment], None]:
        rows, size = slice(first, first + len(batch)), len(batch)

        def add(moment: Moment) -> None:
            speed = torch.where(moment.active, moment.measured.linear_velocity[:, 0], 0.0)
            sums[rows] += speed[:size]
            counts[rows] += moment.active[:size]
            fell[rows] |= moment.fell[:size]

        return add

    run_all(arena, episodes, observe, advance)
    speed = sums / counts
    return {
        "walk_half_mps_survival": share_figure((~fell).numpy()),
        "walk_half_mps_speed": mean_figure(speed.numpy(), "m/s"),
        "walk_half_mps_success": share_figure((~fell & (speed >= 0.5 * WALK_SPEED)).numpy()),
    }


# -- expert activations --------------------------------------------------------------------------------------


def motion_modes(space: CommandSpace) -> dict[str, Tensor]:
    """Name -> command (21,) of the motion modes whose expert activations are compared."""
    modes = {name: space.neutral() for name in ("walk", "turn", "squat", "bend", "stand + arms", "stand")}
    modes["walk"][VELOCITY.start] = WALK_SPEED
    modes["turn"][VELOCITY.stop - 1] = 0.6
    modes["squat"][HEIGHT] = 0.45
    modes["bend"][HEIGHT] = 0.55
    modes["bend"][TORSO.start + 1] = 1.0
    lower, upper = space.bounds()
    # A third of the way from the default to the limits: arms raised sideways, elbows bent.
    modes["stand + arms"][ARMS] += (upper - modes["stand + arms"])[ARMS] / 3.0
    for mode in modes.values():
        mode.clamp_(lower, upper)
    return modes


def mode_episodes(space: CommandSpace, seed: int) -> list[Episode]:
    """MODE_EPISODES episodes of every motion mode, mode by mode, on the first tile."""
    return [
        constant(episode_seeds(seed, index)[1], MODE_TIME, command, flag=1.0)
        for command in motion_modes(space).values()
        for index in range(MODE_EPISODES)
    ]


def run_modes(
    arena: Arena, episodes: Sequence[Episode], advance: Callable[[int], None] = lambda steps: None
) -> np.ndarray:
    """Mean expert activations (modes, experts) after the transient; NaN for modes that nobody survives."""
    network = arena.controller.config.network
    sums = torch.zeros(len(episodes), network.experts if network.mixture else 1)
    counts = torch.zeros(len(episodes), 1)

    def observe(first: int, batch: Sequence[Episode]) -> Callable[[Moment], None]:
        rows, size = slice(first, first + len(batch)), len(batch)

        def add(moment: Moment) -> None:
            counted = (moment.active & (moment.since_change > TRANSIENT))[:size, None]
            sums[rows] += torch.where(counted, moment.gate[:size], 0.0)
            counts[rows] += counted

        return add

    run_all(arena, episodes, observe, advance)
    by_mode = (-1, MODE_EPISODES)
    return (sums.unflatten(0, by_mode).sum(dim=1) / counts.unflatten(0, by_mode).sum(dim=1)).numpy()
