"""Skill tests: a few things that a user asks of a controller, each as data, and figures computed from what it did.

All on flat ground, from standing, with the evaluation protocol's friction and observation noise. Episode i has the
same seed in every test.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from evaluation.protocols.arena import Arena, Episode, HandLoad, Push, episode_seeds
from evaluation.protocols.trace import Channel, Trace, record, time_mean
from evaluation.protocols.tracking import TILE_SIZE
from evaluation.reporting.statistics import Figure, mean_figure, share_figure
from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY, CommandSpace
from lowlevel.world.measures import height_error, torso_error
from lowlevel.world.terrain import TerrainConfig
from robots.g1.constants import ARM_JOINTS, NUM_JOINTS, TORSO_BODY
from robots.g1.kinematics import PALM_FRAMES, Kinematics
from robots.g1.mirror import both_arms

FLAT = TerrainConfig(tiles=("flat",), tile_size=TILE_SIZE)
EPISODES = 200
"""Episodes of each test."""

HOLDING_ARMS = both_arms((-1.19, 0.25, 0.17, 0.43, -0.13, 0.45, 0.05))
"""Arm joints (14,) [rad] that hold a box before the chest: palms facing each other, 0.3 m apart, elbows bent. With the
elbows closer to the body the forearms would lean on the thighs in the deep bend."""
BOX_LOAD = HandLoad(outward=15.0, downward=5.0, begin=1.0)
"""A box of 1 kg squeezed with 15 N, as far as its forces go; its inertia is left out."""

PUSH_SPEED = 0.8
"""Velocity change of a push [m/s]."""
REST_SPEED, REST_WINDOW = 0.1, 0.2
"""A foot moves if it covers a window [s] at more than this mean speed [m/s]: every step does, trembling does not."""
LARGEST_DRIFT, LARGEST_TURN = 0.10, 0.10
"""A robot that stopped stays where it is within this [m], [rad]."""


# -- the tests -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Phase:
    """A command held for a while; what is not said is neutral."""

    duration: float
    """[s]"""
    forward: float = 0.0
    """[m/s]"""
    height: float | None = None
    """[m]"""
    pitch: float = 0.0
    """[rad]"""


@dataclass(frozen=True)
class Skill:
    """One test. The controller slews its references, so every command is set at once."""

    name: str
    description: str
    phases: tuple[Phase, ...]
    measured: tuple[float, float]
    """Begin and end of the time that figures are taken over [s]."""
    load: HandLoad | None = None
    holds: bool = False
    """HOLDING_ARMS throughout, instead of the default arms."""
    push_times: tuple[float, ...] = ()
    """Each changes the velocity by PUSH_SPEED in a random horizontal direction [s]."""

    @property
    def duration(self) -> float:
        """[s]"""
        return sum(phase.duration for phase in self.phases)


_BEND = (Phase(7.0, height=0.38, pitch=1.2), Phase(4.0))
_TAKE_THE_BOX = Phase(2.0)

DEEP_BEND = Skill(
    "deep_bend",
    "bend to height 0.38 m and pitch 1.2 rad, stay, come back up after 7 s and stand for 4 s; errors over the last 5 s "
    "bent. Success: no fall.",
    _BEND,
    measured=(2.0, 7.0),
)
LOADED_BEND = Skill(
    "loaded_bend",
    "the same after 2 s of standing, with the arms before the chest; from 1 s on a 1 kg box between the palms pushes "
    f"each outwards with {BOX_LOAD.outward:g} N and down with {BOX_LOAD.downward:g} N. The palm displacement is the "
    "distance of the palms' mean places in the torso frame with and without the load, all else equal.",
    (_TAKE_THE_BOX, *_BEND),
    measured=(4.0, 9.0),
    load=BOX_LOAD,
    holds=True,
)
UNLOADED_BEND = replace(LOADED_BEND, name="unloaded_bend", load=None)
LOADED_WALK = Skill(
    "loaded_walk",
    "take the same box within 2 s, then walk at 0.4 m/s for 10 s. Success: no fall. The speed is the mean "
    "forward one over these 10 s, setting off included.",
    (_TAKE_THE_BOX, Phase(10.0, forward=0.4)),
    measured=(2.0, 12.0),
    load=BOX_LOAD,
    holds=True,
)
FAST_WALK = Skill(
    "fast_walk",
    "walk at 0.98 m/s for 10 s. Success: no fall. The speed is the mean forward one from 2 s on.",
    (Phase(10.0, forward=0.98),),
    measured=(2.0, 10.0),
)
STOP = Skill(
    "stop",
    "walk at 0.6 m/s for 4 s, then stand for 12 s. Success: no fall; from 2 s after the stop on no foot moves at more "
    f"than {REST_SPEED:g} m/s (mean over any {REST_WINDOW:g} s, so that a step counts and trembling does not); and in "
    f"the 10 s from then to the end the pelvis has moved by at most {LARGEST_DRIFT:.2f} m and turned by at most "
    f"{LARGEST_TURN:.2f} rad. stop_rest is the share that does not fall and whose feet rest.",
    (Phase(4.0, forward=0.6), Phase(12.0)),
    measured=(6.0, 16.0),
)
PUSH = Skill(
    "push",
    f"stand for 8 s; the velocity changes by {PUSH_SPEED:g} m/s in a random horizontal direction at 1 s and again at "
    "4 s. Success: no fall.",
    (Phase(8.0),),
    measured=(1.0, 8.0),
    push_times=(1.0, 4.0),
)
SKILLS = (DEEP_BEND, LOADED_BEND, UNLOADED_BEND, LOADED_WALK, FAST_WALK, STOP, PUSH)


def skill_episodes(skill: Skill, space: CommandSpace, count: int, seed: int) -> list[Episode]:
    """The fixed episodes of a test: episode i is the same for every controller and ``count``."""
    commands = space.neutral().repeat(len(skill.phases), 1)
    for command, phase in zip(commands, skill.phases, strict=True):
        command[VELOCITY.start] = phase.forward
        command[TORSO.start + 1] = phase.pitch
        if phase.height is not None:
            command[HEIGHT] = phase.height
    if skill.holds:
        commands[:, ARMS] = torch.tensor(HOLDING_ARMS, dtype=torch.float32)
    starts = tuple(float(start) for start in np.cumsum([0.0, *(phase.duration for phase in skill.phases[:-1])]))
    episodes = []
    for index in range(count):
        direction_seed, world_seed = episode_seeds(seed, index)
        directions = np.random.default_rng(direction_seed).uniform(-np.pi, np.pi, len(skill.push_times))
        pushes = tuple(
            Push(time, (PUSH_SPEED * float(np.cos(angle)), PUSH_SPEED * float(np.sin(angle)), 0.0))
            for time, angle in zip(skill.push_times, directions, strict=True)
        )
        flags = torch.ones(len(starts))
        schedule = (world_seed, skill.duration, starts, commands, flags)
        episodes.append(Episode(*schedule, pushes=pushes, load=skill.load, stands_up=False))
    return episodes


# -- running them --------------------------------------------------------------------------------------------


CHANNELS: dict[str, Channel] = {
    "height_error": Channel(lambda moment: height_error(moment.measured, moment.command)),
    "pitch_error": Channel(lambda moment: torso_error(moment.measured, moment.command)[:, 1]),
    "forward_speed": Channel(lambda moment: moment.measured.linear_velocity[:, 0]),
    "position": Channel(lambda moment: moment.measured.robot.base_position[:, :2], (2,)),
    "heading": Channel(lambda moment: moment.measured.heading),
    "foot_position": Channel(lambda moment: moment.measured.robot.foot_position, (2, 3)),
    "arms": Channel(lambda moment: moment.measured.robot.joint_position[:, ARM_JOINTS], (14,)),
}
"""Of the pelvis and the feet in the world, errors measured - commanded."""


def run_skills(
    arena: Arena, episodes: Mapping[str, Sequence[Episode]], advance: Callable[[int], None] = lambda steps: None
) -> dict[str, Figure]:
    """Run every test's episodes, by name, on flat ground and reduce them to figures."""
    return skill_figures({name: record(arena, batch, CHANNELS, advance) for name, batch in episodes.items()})


# -- figures -------------------------------------------------------------------------------------------------


def skill_figures(traces: Mapping[str, Trace]) -> dict[str, Figure]:
    """Figures by name from the traces of all :data:`SKILLS`, by name.

    Means are over the steps before a fall; an episode that falls before its measured time has none.
    """
    figures = {
        f"{skill.name}_success": share_figure(~traces[skill.name].has_fallen)
        for skill in (DEEP_BEND, LOADED_BEND, LOADED_WALK, FAST_WALK, PUSH)
    }
    for skill in (DEEP_BEND, LOADED_BEND):
        trace = traces[skill.name]
        held = trace.steps(*skill.measured)
        figures[f"{skill.name}_height_error"] = mean_figure(time_mean(np.abs(trace["height_error"][:, held])), "m")
        figures[f"{skill.name}_pitch_error"] = mean_figure(time_mean(np.abs(trace["pitch_error"][:, held])), "rad")
    displacement = palm_displacement(traces[LOADED_BEND.name], traces[UNLOADED_BEND.name], LOADED_BEND.measured)
    figures["loaded_bend_palm_displacement"] = mean_figure(displacement, "m")
    for skill in (LOADED_WALK, FAST_WALK):
        walk = traces[skill.name]
        speed = time_mean(walk["forward_speed"][:, walk.steps(*skill.measured)])
        figures[f"{skill.name}_speed"] = mean_figure(speed, "m/s")
    stop = traces[STOP.name]
    rests = feet_rest(stop, STOP.measured[0])
    moved, turned = drift(stop, *STOP.measured)
    figures["stop_success"] = share_figure(rests & (moved <= LARGEST_DRIFT) & (turned <= LARGEST_TURN))
    figures["stop_rest"] = share_figure(rests)
    figures["stop_drift"], figures["stop_turn"] = mean_figure(moved, "m"), mean_figure(turned, "rad")
    return figures


def palm_displacement(loaded: Trace, unloaded: Trace, time: tuple[float, float]) -> np.ndarray:
    """Distance in the torso frame of the palms' mean places with and without a load (E,) [m], mean of both hands."""
    with_load, without = (
        palms_in_torso(time_mean(trace["arms"][:, trace.steps(*time)])) for trace in (loaded, unloaded)
    )
    return np.linalg.norm(with_load - without, axis=-1).mean(axis=-1)


def palms_in_torso(arms: np.ndarray) -> np.ndarray:
    """Palm positions (E, 2, 3) [m] in the frame of the torso link for arm joints (E, 14) [rad]; NaN gives NaN."""
    kinematics = Kinematics()
    palms = np.full((len(arms), 2, 3), np.nan)
    for row in np.flatnonzero(~np.isnan(arms).any(axis=1)):
        joints = np.zeros(NUM_JOINTS)
        joints[ARM_JOINTS] = arms[row]
        frames = kinematics.placements(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *joints]))
        palms[row] = [frames[TORSO_BODY].actInv(frames[palm]).translation for palm in PALM_FRAMES]
    return palms


def feet_rest(trace: Trace, since: float) -> np.ndarray:
    """Whether no foot moves from ``since`` [s] to the end, by REST_SPEED and REST_WINDOW (E,); false after a fall."""
    window = round(REST_WINDOW / trace.period)
    places = trace["foot_position"][:, round(since / trace.period) - 1 :]
    moved = np.linalg.norm(places[:, window:] - places[:, :-window], axis=-1)
    return (moved <= REST_SPEED * REST_WINDOW).all(axis=(1, 2)) & ~trace.has_fallen


def drift(trace: Trace, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """How far the pelvis has moved [m] and turned [rad] between two times [s] (E,); NaN after a fall."""
    first, last = (round(time / trace.period) - 1 for time in (begin, end))
    moved = np.linalg.norm(trace["position"][:, last] - trace["position"][:, first], axis=-1)
    turned = trace["heading"][:, last] - trace["heading"][:, first]
    return moved, np.abs((turned + np.pi) % (2.0 * np.pi) - np.pi)


# -- report --------------------------------------------------------------------------------------------------


SKILL_FIGURES = (
    "deep_bend_success",
    "deep_bend_height_error",
    "deep_bend_pitch_error",
    "loaded_bend_success",
    "loaded_bend_height_error",
    "loaded_bend_pitch_error",
    "loaded_bend_palm_displacement",
    "loaded_walk_success",
    "loaded_walk_speed",
    "fast_walk_success",
    "fast_walk_speed",
    "stop_success",
    "stop_rest",
    "stop_drift",
    "stop_turn",
    "push_success",
)
"""Rows of the report's table."""
