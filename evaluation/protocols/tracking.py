"""The tracking protocol: which episodes are run, and the table of commands that figures are computed from.

Episodes last 20 s with a new command every 10 s from a fixed mixture, without pushes, with observation noise,
friction 0.6 to 1.0 and physics at 2 ms. Every command counts in full: one that ends in a fall at the mean error it
had until then, and the one after it from standing. Beside the tracking errors stand what walking costs and how fast
the joint targets move.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evaluation.protocols.arena import Arena, Episode, Moment, constant, episode_seeds
from evaluation.protocols.trace import Channel, Trace, record, time_mean
from evaluation.reporting.statistics import Figure, mean_figure, share_figure
from lowlevel.commands import (
    ARMS,
    HEIGHT,
    KINDS,
    PROTOCOL,
    STANDING_SPEED,
    TORSO,
    VELOCITY,
    CommandSampler,
    CommandSpace,
    is_walking,
    shares,
)
from lowlevel.world.measures import TRACKING_FIGURES, velocity_error
from lowlevel.world.terrain import TerrainConfig

EPISODE_LENGTH = 20.0
"""[s]"""
COMMAND_INTERVAL = 10.0
"""[s]"""
TRANSIENT = 2.0
"""Time after a change of command that steady figures leave out [s]."""
TILE_SIZE = 16.0
"""Side of a tile [m]: wide enough that walking robots rarely leave it."""

AVERAGING = 0.5
"""Time over which velocities are averaged for the errors that leave out the sway of a gait [s]."""

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


def protocol_episodes(
    space: CommandSpace, count: int, seed: int, tiles: int, duration: float = EPISODE_LENGTH
) -> list[Episode]:
    """The fixed episodes of an evaluation: episode i is the same for every controller and ``count``."""
    sampler, mixture, everything = CommandSampler(space), shares(PROTOCOL), torch.ones(len(KINDS))
    starts = tuple(np.arange(0.0, duration, COMMAND_INTERVAL).tolist())
    episodes = []
    for index in range(count):
        command_seed, world_seed = episode_seeds(seed, index)
        generator = torch.Generator().manual_seed(command_seed)
        kinds = sampler.draw_kinds(len(starts), mixture, generator)
        commands, flags = sampler.sample(kinds, everything, generator)
        episodes.append(Episode(world_seed, duration, starts, commands, flags[:, 0], index % tiles))
    return episodes


def group_of(command: Tensor, flag: Tensor) -> Tensor:
    """Index into :data:`GROUPS` (N,) of commands (N, 21) with flags (N,), as they are drawn and before they are cut."""
    works = torch.where(is_walking(command), 0, 1)
    return torch.where(flag > 0.5, works, 2)


FIGURES: dict[str, str] = {name: unit for name, (unit, _) in TRACKING_FIGURES.items()} | {
    "E_v_mean": "m/s",
    "E_omega_mean": "rad/s",
}
"""Tracking figures and their units: the paper's, and the velocity errors of 0.5 s averages."""


def travel_speed(moment: Moment) -> Tensor:
    """Speed in the commanded direction (N,) [m/s]; NaN where the command asks for no translation."""
    wanted = moment.command[:, VELOCITY][:, :2]
    speed = wanted.norm(dim=-1)
    made_good = (moment.measured.linear_velocity[:, :2] * wanted).sum(-1) / speed.clamp_min(STANDING_SPEED)
    return torch.where(speed >= STANDING_SPEED, made_good, torch.nan)


CHANNELS: dict[str, Channel] = {
    **{
        name: Channel(lambda moment, error=error: error(moment.measured, moment.command))  # type: ignore[misc]
        for name, (_, error) in TRACKING_FIGURES.items()
    },
    "velocity_error": Channel(lambda moment: velocity_error(moment.measured, moment.command), (3,)),
    "travel_speed": Channel(travel_speed),
    "work": Channel(lambda moment: moment.work),
    "targets": Channel(lambda moment: moment.targets, (29,)),
}


@dataclass(frozen=True)
class CommandTable:
    """One row per command of every episode, all (rows,); NaN where a row has nothing to say."""

    episode: np.ndarray
    tile: np.ndarray
    """Index into the terrain's kinds of tile."""
    group: np.ndarray
    """Index into GROUPS."""
    columns: dict[str, np.ndarray]
    """The tracking figures, the same with "_steady", and "fell", "failed", "energy" [J], "progress" [m], "speed" [m/s]
    and "action_rate" [rad]."""

    def select(self, rows: np.ndarray) -> CommandTable:
        """The table of some ``rows``."""
        columns = {name: column[rows] for name, column in self.columns.items()}
        return CommandTable(self.episode[rows], self.tile[rows], self.group[rows], columns)

    def by_episode(self, name: str) -> np.ndarray:
        """Mean of a column over the commands of each episode (episodes,): the independent unit."""
        episodes = np.unique(self.episode)
        rows = self.columns[name]
        return np.array([_nan_mean(rows[self.episode == episode]) for episode in episodes])

    def write(self, path: Path, tiles: Sequence[str]) -> None:
        """Write a CSV file with a header."""
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["episode", "tile", "group", *self.columns])
            for row, episode in enumerate(self.episode):
                names = [tiles[self.tile[row]], GROUPS[self.group[row]]]
                writer.writerow([episode, *names, *(f"{column[row]:.6g}" for column in self.columns.values())])


def run_tracking(
    arena: Arena, episodes: Sequence[Episode], advance: Callable[[int], None] = lambda steps: None
) -> tuple[CommandTable, np.ndarray]:
    """Run ``episodes``, which change their commands together.

    Returns:
        the table of their commands, and the mean figures over the time since a command began (steps, figures).
    """
    return tabulate(record(arena, episodes, CHANNELS, advance), episodes, arena.world.terrain.config)


def tabulate(trace: Trace, episodes: Sequence[Episode], terrain: TerrainConfig) -> tuple[CommandTable, np.ndarray]:
    """What :func:`run_tracking` returns, from a ``trace`` with its channels on a ``terrain``."""
    starts = [round(start / trace.period) for start in episodes[0].starts]
    ends = [*starts[1:], trace.fell.shape[1]]
    spans = [slice(start, end) for start, end in zip(starts, ends, strict=True)]
    parts = [command_columns(trace, span) for span in spans]
    tiles = terrain.place_of(torch.tensor([episode.tile for episode in episodes]))[0].numpy()
    flags = torch.cat([episode.flags for episode in episodes])
    group = group_of(torch.cat([episode.commands for episode in episodes]), flags).numpy()
    # An episode's commands follow one another.
    columns = {name: np.stack([part[name] for part in parts], axis=1).reshape(-1) for name in parts[0]}
    for name in ("E_arm", "E_arm_steady"):
        columns[name][flags.numpy() < 0.5] = np.nan
    count = len(spans)
    table = CommandTable(np.repeat(np.arange(len(episodes)), count), np.repeat(tiles, count), group, columns)
    errors = np.stack([trace[name] for name in TRACKING_FIGURES], axis=-1)
    length = min(span.stop - span.start for span in spans)
    together = np.concatenate([errors[:, span][:, :length] for span in spans])
    return table, time_mean(together, axis=0)


def command_columns(trace: Trace, span: slice) -> dict[str, np.ndarray]:
    """Columns of a :class:`CommandTable` for the command that is told during ``span``; all (E,)."""
    steady = slice(min(span.start + round(TRANSIENT / trace.period), span.stop), span.stop)
    columns: dict[str, np.ndarray] = {}
    for suffix, steps in (("", span), ("_steady", steady)):
        for name in TRACKING_FIGURES:
            columns[name + suffix] = time_mean(trace[name][:, steps])
        averaged = window_means(trace["velocity_error"][:, steps], round(AVERAGING / trace.period))
        columns[f"E_v_mean{suffix}"] = time_mean(np.abs(averaged[..., :2]).sum(axis=-1))
        columns[f"E_omega_mean{suffix}"] = time_mean(np.abs(averaged[..., 2]))
    columns["fell"] = trace.fell[:, span].any(axis=1).astype(float)
    columns["failed"] = trace.failed[:, span].any(axis=1).astype(float)
    speed = trace["travel_speed"][:, span]
    columns["energy"] = np.nansum(np.where(np.isnan(speed), np.nan, trace["work"][:, span]), axis=1, dtype=float)
    columns["progress"] = np.nansum(speed, axis=1, dtype=float) * trace.period
    columns["action_rate"] = time_mean(np.abs(np.diff(trace["targets"][:, span], axis=1)).mean(axis=-1))
    return columns


def window_means(values: np.ndarray, length: int) -> np.ndarray:
    """Means (E, windows, D) of ``values`` (E, T, D) over windows of ``length`` steps; NaN where one has a NaN."""
    count = values.shape[1] // length
    windows = values[:, : count * length].reshape(len(values), count, length, values.shape[2])
    return windows.mean(axis=2, dtype=float)


def _nan_mean(values: np.ndarray) -> float:
    present = values[~np.isnan(values)]
    return float(present.mean()) if len(present) else float("nan")


def tracking_figures(table: CommandTable, tile_names: Sequence[str]) -> dict[str, Figure]:
    """Figures by name: ``E_v``, ``E_v_steady``, ``E_v_walk_only`` and so on, fall rates, and what walking costs.

    ``fall_rate`` is the share of episodes with a fall, ``fall_rate_command`` that of commands.
    """
    figures: dict[str, Figure] = {}
    parts = {"": table}
    parts |= {f"_{name}": table.select(table.group == number) for number, name in enumerate(GROUPS)}
    parts |= {f"_on_{name}": table.select(table.tile == number) for number, name in enumerate(tile_names)}
    for suffix, part in parts.items():
        for name, unit in FIGURES.items():
            figures[name + suffix] = mean_figure(part.by_episode(name), unit)
            figures[f"{name}{suffix}_steady"] = mean_figure(part.by_episode(f"{name}_steady"), unit)
        figures[f"fall_rate{suffix}"] = share_figure(part.by_episode("fell").astype(bool))
        figures[f"fall_rate_command{suffix}"] = mean_figure(part.by_episode("fell"), "1")
    figures["non_finite_rate"] = share_figure(table.by_episode("failed").astype(bool))
    figures["energy_per_meter"] = energy_per_meter(table.by_episode("energy"), table.by_episode("progress"))
    figures["action_rate"] = mean_figure(table.by_episode("action_rate"), "rad")
    return figures


COMPARED = (*FIGURES, "fell", "action_rate")
"""Columns that two controllers are compared by."""


def paired_differences(ours: CommandTable, other: CommandTable) -> dict[str, Figure]:
    """Ours minus the other's, episode by episode of the same seeds, by column.

    Raises:
        ValueError: if the tables are not of the same episodes.
    """
    if not np.array_equal(ours.episode, other.episode):
        raise ValueError("only tables of the same episodes can be compared")
    units = {**FIGURES, "fell": "1", "action_rate": "rad"}
    return {name: mean_figure(ours.by_episode(name) - other.by_episode(name), units[name]) for name in COMPARED}


def energy_per_meter(energy: np.ndarray, progress: np.ndarray) -> Figure:
    """All work over all way made good [J/m], from episodes' ``energy`` [J] and ``progress`` [m]; both (episodes,).

    Single episodes give no usable ratio: one that only staggers on the spot has made no way. The ratio of the sums is
    the mean of its own linearization, one number per episode, which gives the interval.
    """
    traveled = energy > 0.0
    energy, progress = energy[traveled], progress[traveled]
    if progress.sum() <= 0.0:
        return Figure(None, "J/m", None, 0)
    ratio = energy.sum() / progress.sum()
    return mean_figure(ratio + (energy - ratio * progress) / progress.mean(), "J/m")


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
    trace = record(arena, episodes, _FORWARD, advance)
    speed, fell = time_mean(trace["speed"]), trace.has_fallen
    return {
        "walk_half_mps_survival": share_figure(~fell),
        "walk_half_mps_speed": mean_figure(speed, "m/s"),
        "walk_half_mps_success": share_figure(~fell & (speed >= 0.5 * WALK_SPEED)),
    }


_FORWARD = {"speed": Channel(lambda moment: moment.measured.linear_velocity[:, 0])}


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
    gates = record(arena, episodes, {"gate": Channel(lambda m: m.gate, (arena.experts,))}, advance)
    steady = gates["gate"][:, round(TRANSIENT / arena.period) :]
    return time_mean(steady.reshape(-1, MODE_EPISODES * steady.shape[1], steady.shape[2]))
