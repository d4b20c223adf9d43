"""The stages of a training as data, and named configurations made of them."""

from __future__ import annotations

from dataclasses import replace

from lowlevel.gait_prior import GaitPriorConfig
from lowlevel.networks.actor import NetworkConfig
from lowlevel.rewards import RewardWeights
from lowlevel.stages import Stage
from lowlevel.trainer import TrainingConfig
from lowlevel.world.randomization import RandomizationConfig
from lowlevel.world.terrain import TerrainConfig

TRACKING = RewardWeights(
    linear_velocity=6.0,
    linear_velocity_fine=4.0,
    angular_velocity=5.0,
    angular_velocity_fine=3.0,
    mean_linear_velocity=3.0,
    mean_angular_velocity=3.0,
    capture_point=5.0,
    base_height=5.0,
    torso_orientation=8.0,
    upper_body_position=1.5,
    alive=1.0,
    vertical_velocity=-0.5,
    base_motion=-0.05,
    feet_close=-10.0,
    stand_still=-1.0,
    torque_limits=-0.1,
    feet_stumble=-30.0,
)
"""Tracking counts for more than in the paper, and with it what is added to it."""

SHAPED = replace(
    TRACKING,
    feet_stumble=-1.0,
    velocity_progress=4.0,
    foot_phase=3.0,
    foot_placement=5.0,
    contact_schedule=2.0,
    swing_height=3.0,
    linear_velocity_fine=3.0,
)
"""While the robot learns what a step is."""

STEPPING = replace(TRACKING, energy=-0.01, foot_phase=2.0, foot_placement=2.0, contact_schedule=1.0, swing_height=2.0)
"""While it improves its steps: shaping that has done its work makes a fall cost more, and speed cost falls."""

EXACT = replace(STEPPING, alive=-10.0, angular_velocity=14.0, mean_linear_velocity=20.0, mean_angular_velocity=10.0)
"""For a robot that seldom falls. A fall forfeits some two seconds of reward; with 10 per second less of it errors count
for more."""

CAREFUL = replace(EXACT, termination=-3000.0, torso_orientation=14.0)
"""For one that is to be shipped: a fall costs two thirds more."""

GENTLE = RandomizationConfig(
    friction=(0.6, 1.2),
    hand_load_probability=0.0,
    start_velocity=0.1,
    push_velocity=0.15,
    standing_push_velocity=0.15,
    delay=(0.7, 0.3, 0.0),
    waist_effort=(50.0, 50.0),
    map_offset=0.0,
    map_drift=0.0,
    map_delay=(1.0, 0.0, 0.0),
)
"""For a robot that still learns to walk, or what falls without any push."""

LOADED = replace(GENTLE, hand_load_probability=0.4)
"""For one that moves safely in all postures: loads in the hands of some."""

HARD = RandomizationConfig()
"""For a controller that is to be shipped: loads in the hands, late and weak motors, slippery ground, hard pushes."""

WORK = (("steer", 0.2), ("stand", 0.05), ("stand_and_work", 0.4), ("walk_and_work", 0.35))
"""For postures and moving arms."""

EVERYTHING = (
    ("forward", 0.12),
    ("steer", 0.12),
    ("slow", 0.06),
    ("stand", 0.05),
    ("stand_and_work", 0.18),
    ("stand_and_hold", 0.12),
    ("walk_and_work", 0.26),
    ("walk_and_hold", 0.09),
)
"""Unlike the evaluation it also stands in the neutral posture, what a planner starts from and stops in, walks slowly,
walks straight on, where it is fastest, and holds both arms before its chest, as around a box."""

HOLDING = (("steer", 0.15), ("stand_and_work", 0.15), ("stand_and_hold", 0.5), ("walk_and_hold", 0.2))
"""Mostly for loads before the chest: under them a robot that has learned everything at once leans forwards."""

HASTENING = (
    ("forward", 0.45),
    ("steer", 0.15),
    ("stand", 0.05),
    ("stand_and_work", 0.1),
    ("stand_and_hold", 0.1),
    ("walk_and_work", 0.15),
)
"""Mostly for speed, which is forgotten where one command in a hundred is to walk fast straight on."""

CATCHING = (("stand", 0.25), ("steer", 0.2), ("stand_and_work", 0.2), ("stand_and_hold", 0.1), ("walk_and_work", 0.25))
"""Mostly for pushes, which fell a robot that stands before any other."""

CLEARING = (("forward", 0.1), ("steer", 0.25), ("stand", 0.05), ("walk_and_work", 0.6))
"""To walk, mostly bent and with moving arms, where feet that run into edges fell the robot."""

UNEVEN = TerrainConfig(tiles=("flat", "rough"), levels=(0.5,), tile_size=8.0)
"""Harder than the paper's simple terrain: flat, and steps of up to 6 cm, in a tenth of the blocks that slabs take."""

SLOW_STEPS = 1.43
"""Gait frequency for a robot that learns to walk [Hz]: at 2 Hz the prior's legs, which follow late, turn the pelvis by
more than 1 rad/s. One that walks falls less the more often it steps."""

ANSWERS = GaitPriorConfig(lift=0.0, shift=0.0, stride=(0.0, 0.0, 0.0), balance=4.0, braking=0.3, turning_back=0.1)
"""What a robot that walks still lacks in postures that it did not know when it absorbed the first prior."""

STAGES = (
    Stage(
        name="balance",
        waits_for="curriculum/steps_between_falls/forward",
        above=150.0,
        most_steps=5_000_000,
        gait_noise=0.0,
        normalizes_by_kind=False,
        gait_frequency=SLOW_STEPS,
        std=(0.4, 1.0),
        prior=GaitPriorConfig(),
        mixture=(("forward", 0.5), ("steer", 0.3), ("stand", 0.1), ("squat", 0.1)),
        rewards=SHAPED,
        randomization=GENTLE,
    ),
    Stage(
        name="walk",
        waits_for="curriculum/opening/forward",
        above=0.95,
        most_steps=6_000_000,
        gait_noise=0.0,
        normalizes_by_kind=False,
        gait_frequency=SLOW_STEPS,
        std=(0.2, 0.3),
        prior=GaitPriorConfig(),
        mixture=(("forward", 0.5), ("steer", 0.3), ("stand", 0.1), ("squat", 0.1)),
        rewards=SHAPED,
        randomization=GENTLE,
    ),
    Stage(
        name="stride",
        waits_for="curriculum/quality/forward",
        above=0.55,
        most_steps=4_000_000,
        gait_frequency=SLOW_STEPS,
        std=(0.2, 0.3),
        mixture=(("forward", 0.6), ("steer", 0.15), ("stand", 0.25)),
        rewards=STEPPING,
        randomization=GENTLE,
    ),
    Stage(
        name="steer",
        waits_for="curriculum/quality/steer",
        above=0.55,
        most_steps=6_000_000,
        std=(0.2, 0.3),
        mixture=(("forward", 0.25), ("steer", 0.45), ("slow", 0.1), ("stand", 0.2)),
        rewards=STEPPING,
        randomization=GENTLE,
    ),
    Stage(
        name="squat",
        waits_for="curriculum/opening/squat",
        above=0.98,
        most_steps=8_000_000,
        std=(0.2, 0.3),
        noise_at_rest=0.4,
        mixture=(("steer", 0.4), ("slow", 0.1), ("stand", 0.1), ("squat", 0.4)),
        rewards=STEPPING,
        randomization=GENTLE,
    ),
    Stage(
        name="bend and reach",
        waits_for="curriculum/opening/stand_and_work",
        above=0.98,
        most_steps=15_000_000,
        std=(0.2, 0.3),
        noise_at_rest=0.4,
        prior=ANSWERS,
        mixture=(("steer", 0.3), ("slow", 0.1), ("stand", 0.1), ("stand_and_work", 0.5)),
        rewards=STEPPING,
        randomization=GENTLE,
    ),
    Stage(
        name="walk and work",
        waits_for="curriculum/steps_between_falls/stand_and_work",
        above=1500.0,
        least_steps=15_000_000,  # at first, in what is open by then, robots seldom fall
        most_steps=40_000_000,
        std=(0.2, 0.3),
        noise_at_rest=0.4,
        mixture=WORK,
        rewards=STEPPING,
        randomization=GENTLE,
    ),
    Stage(
        name="answer",
        most_steps=1_000_000,
        std=(0.2, 0.3),
        noise_at_rest=0.4,
        prior=ANSWERS,
        mixture=WORK,
        rewards=STEPPING,
        randomization=GENTLE,
    ),
    Stage(
        name="carry",
        calibrates=True,
        waits_for="curriculum/hardness",
        above=0.8,
        least_steps=15_000_000,
        most_steps=40_000_000,
        std=(0.2, 0.3),
        noise_at_rest=0.4,
        mixture=EVERYTHING,
        rewards=EXACT,
        randomization=LOADED,
        harder=HARD,
    ),
    Stage(
        name="hold",
        most_steps=5_000_000,
        std=(0.2, 0.2),
        noise_at_rest=0.5,
        mixture=HOLDING,
        rewards=EXACT,
        randomization=replace(GENTLE, hand_load_probability=0.8),
    ),
    Stage(
        name="catch",
        most_steps=6_000_000,
        std=(0.12, 0.15),
        noise_at_rest=0.6,
        mixture=CATCHING,
        rewards=EXACT,
        randomization=replace(LOADED, standing_push_velocity=0.8, push_interval=(2.0, 5.0)),
    ),
    Stage(
        name="hasten",
        most_steps=6_000_000,
        std=(0.15, 0.2),
        noise_at_rest=0.5,
        mixture=HASTENING,
        rewards=EXACT,
        randomization=replace(LOADED, standing_push_velocity=0.4),
    ),
    Stage(
        name="clear",
        most_steps=20_000_000,
        std=(0.15, 0.2),
        noise_at_rest=0.5,
        advantage_limit=10.0,
        mixture=CLEARING,
        terrain=replace(UNEVEN, tiles=("rough",), levels=(0.8,)),  # over small steps it falls too seldom to learn
        rewards=replace(EXACT, termination=-10_000.0, feet_stumble=-100.0, low_swing=-8.0),  # a fall costs fourfold
        randomization=replace(LOADED, standing_push_velocity=0.4),
    ),
    Stage(
        name="settle",
        calibrates=True,  # what a robot answers in much noise is not what it answers in little
        waits_for="curriculum/hardness",
        above=0.95,
        least_steps=8_000_000,
        most_steps=15_000_000,
        std=(0.1, 0.1),
        noise_at_rest=0.6,
        advantage_limit=10.0,
        mixture=EVERYTHING,
        terrain=UNEVEN,
        rewards=EXACT,
        randomization=LOADED,
        harder=HARD,
    ),
    Stage(
        name="harden",
        waits_for="curriculum/steps_between_falls/walk_and_work",
        above=2000.0,
        least_steps=5_000_000,
        most_steps=40_000_000,
        std=(0.08, 0.1),
        noise_at_rest=0.6,
        rollout_doublings=1,
        advantage_limit=10.0,
        mixture=EVERYTHING,
        terrain=UNEVEN,
        rewards=CAREFUL,
        randomization=HARD,
    ),
    Stage(
        name="refine",
        calibrates=True,  # it has leaned under loads again meanwhile
        std=(0.05, 0.08),
        rollout_doublings=2,
        advantage_limit=10.0,
        mixture=EVERYTHING,
        terrain=UNEVEN,
        rewards=replace(CAREFUL, foot_phase=0.0, foot_placement=0.0, contact_schedule=0.0, swing_height=0.0),
        randomization=HARD,
    ),
)
"""From nothing to the controller: balance with a gait prior, walk with it, absorb it, steer, then open one kind of
command after the other, absorb better answers, walk as told, hold loads, catch itself after pushes, walk fast, clear
edges, then everything with disturbances, at last with less noise and without shaping."""


OBSTACLES = TerrainConfig(
    tiles=("flat", "rough", "slope", "stairs", "platform"), levels=(0.0, 0.25, 0.5, 0.75, 1.0), tile_size=8.0
)
"""The full terrain of the paper; robots climb from level to level."""

CROSSING = (
    ("forward", 0.15),
    ("steer", 0.2),
    ("slow", 0.05),
    ("stand", 0.05),
    ("stand_and_work", 0.15),
    ("walk_and_work", 0.4),
)
"""As EVERYTHING, and more that walks straight on."""

SEEING_STAGES = (
    Stage(
        name="climb",
        waits_for="curriculum/level/stairs",
        above=0.5,
        least_steps=10_000_000,
        most_steps=100_000_000,
        std=(0.2, 0.3),
        noise_at_rest=0.4,
        mixture=CROSSING,
        terrain=OBSTACLES,
        rewards=EXACT,
        randomization=LOADED,
    ),
    Stage(
        name="climb as seen",
        waits_for="curriculum/hardness",
        above=0.98,
        most_steps=60_000_000,
        std=(0.1, 0.15),
        noise_at_rest=0.6,
        mixture=CROSSING,
        terrain=OBSTACLES,
        rewards=EXACT,
        randomization=LOADED,
        harder=HARD,
    ),
    Stage(
        name="refine",
        std=(0.05, 0.08),
        noise_at_rest=0.75,
        rollout_doublings=1,
        mixture=CROSSING,
        terrain=OBSTACLES,
        rewards=EXACT,
        randomization=HARD,
    ),
)
"""What a robot that walks blindly learns once it sees, on exact maps first; no run has gone through them yet."""


def _paper_weights(stage: Stage) -> Stage:
    """``stage`` with the paper's rewards alone, once there is a gait."""
    return stage if stage.rewards is SHAPED else replace(stage, rewards=RewardWeights())


SIMPLE = TrainingConfig(stages=STAGES, network=NetworkConfig(vision=False))
SEEING = replace(SIMPLE, stages=SEEING_STAGES, network=NetworkConfig())

PRESETS: dict[str, TrainingConfig] = {
    # Blind, as the paper's row of that name: of slabs that differ by 2 cm, seen with 2 cm of noise, the map tells the
    # policy nothing, and an update without it takes half the time.
    "simple": SIMPLE,
    "no-moe": replace(SIMPLE, network=replace(SIMPLE.network, mixture=False)),
    # With the elevation map, from the networks of a blind run (--blind), and the paper's ablation of the map's encoder
    "vision": SEEING,
    "no-attention": replace(SEEING, network=replace(SEEING.network, attention=False)),
    # Ablations of what this implementation adds
    "paper-weights": replace(SIMPLE, stages=tuple(_paper_weights(stage) for stage in STAGES)),
    "no-mirror": replace(SIMPLE, ppo=replace(SIMPLE.ppo, mirror_loss_weight=0.0)),
}
"""Name to configuration, for ``train-lowlevel --preset``."""
