from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from evaluation.protocols.arena import Arena, Push
from evaluation.protocols.skills import (
    BOX_LOAD,
    CHANNELS,
    DEEP_BEND,
    FLAT,
    HOLDING_ARMS,
    LOADED_BEND,
    LOADED_WALK,
    PUSH,
    PUSH_SPEED,
    SKILL_FIGURES,
    SKILLS,
    STOP,
    UNLOADED_BEND,
    Phase,
    drift,
    feet_rest,
    palm_displacement,
    palms_in_torso,
    skill_episodes,
    skill_figures,
)
from evaluation.protocols.trace import Trace, record
from lowlevel.control.controller import Controller
from robots.g1.constants import ARM_JOINTS, JOINT_NAMES, PALM_OFFSET, SIDES, TORSO_BODY
from robots.g1.model import build_spec

PERIOD = 0.02


@pytest.fixture(scope="module")
def controller(untrained_controller: Path) -> Controller:
    return Controller.load(untrained_controller)


def standing_trace(duration: float, episodes: int = 1) -> Trace:
    """Robots that stand still and track their command perfectly."""
    steps = round(duration / PERIOD)
    feet = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])
    return Trace(
        period=PERIOD,
        channels={
            "height_error": np.zeros((episodes, steps)),
            "pitch_error": np.zeros((episodes, steps)),
            "forward_speed": np.zeros((episodes, steps)),
            "position": np.zeros((episodes, steps, 2)),
            "heading": np.zeros((episodes, steps)),
            "foot_position": np.broadcast_to(feet, (episodes, steps, 2, 3)).copy(),
            "arms": np.broadcast_to(HOLDING_ARMS, (episodes, steps, 14)).copy(),
        },
        fell=np.zeros((episodes, steps), dtype=bool),
        failed=np.zeros((episodes, steps), dtype=bool),
    )


# -- the tests as data ---------------------------------------------------------------------------------------


def test_an_episode_is_the_same_in_tests_of_any_size(controller: Controller) -> None:
    space = controller.command_space
    for skill in SKILLS:
        few, many = skill_episodes(skill, space, 2, 7), skill_episodes(skill, space, 5, 7)
        assert len(many) == 5 and len({episode.seed for episode in many}) == 5
        for a, b in zip(few, many, strict=False):
            assert (a.seed, a.duration, a.starts, a.pushes) == (b.seed, b.duration, b.starts, b.pushes)
            assert torch.equal(a.commands, b.commands)


def test_phases_become_commands_that_the_controller_does_not_change(controller: Controller) -> None:
    (bend,) = skill_episodes(LOADED_BEND, controller.command_space, 1, 0)
    assert bend.starts == (0.0, 2.0, 9.0) and bend.duration == 13.0 and bend.load == BOX_LOAD
    assert bend.commands[:, 3].tolist() == pytest.approx([0.76, 0.38, 0.76])
    assert bend.commands[:, 5].tolist() == pytest.approx([0.0, 1.2, 0.0])
    np.testing.assert_allclose(bend.commands[:, 7:], np.tile(HOLDING_ARMS, (3, 1)), atol=1e-6)
    torch.testing.assert_close(controller.clamp_command(bend.commands), bend.commands)
    (stop,) = skill_episodes(STOP, controller.command_space, 1, 0)
    assert stop.starts == (0.0, 4.0) and stop.commands[:, 0].tolist() == pytest.approx([0.6, 0.0])
    with_load, without = (skill_episodes(s, controller.command_space, 3, 0) for s in (LOADED_BEND, UNLOADED_BEND))
    assert [e.seed for e in with_load] == [e.seed for e in without] and without[0].load is None


def test_pushes_are_horizontal_equally_strong_and_point_everywhere(controller: Controller) -> None:
    episodes = skill_episodes(PUSH, controller.command_space, 200, 0)
    assert all([push.time for push in episode.pushes] == [1.0, 4.0] for episode in episodes)
    changes = np.array([push.velocity_change for episode in episodes for push in episode.pushes])
    np.testing.assert_allclose(np.linalg.norm(changes[:, :2], axis=1), PUSH_SPEED)
    assert (changes[:, 2] == 0.0).all()
    quadrant = (changes[:, 0] > 0.0) * 2 + (changes[:, 1] > 0.0)
    assert np.bincount(quadrant).min() > 60, "400 directions, 100 to a quadrant"
    assert abs(np.corrcoef(changes[0::2, 0], changes[1::2, 0])[0, 1]) < 0.3


def test_palms_agree_with_mujoco_and_hold_a_box() -> None:
    model = build_spec().compile()
    data = mujoco.MjData(model)
    arms = np.stack([HOLDING_ARMS, np.random.default_rng(0).uniform(-0.5, 0.5, 14)])
    for row, joints in zip(palms_in_torso(arms), arms, strict=True):
        for name, angle in zip(JOINT_NAMES[ARM_JOINTS], joints, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_kinematics(model, data)
        torso = data.body(TORSO_BODY)
        for palm, side in zip(row, SIDES, strict=True):
            hand = data.body(f"{side}_wrist_yaw_link")
            world = hand.xpos + hand.xmat.reshape(3, 3) @ np.array(PALM_OFFSET)
            np.testing.assert_allclose(palm, torso.xmat.reshape(3, 3).T @ (world - torso.xpos), atol=1e-5)
    left, right = palms_in_torso(arms)[0]
    np.testing.assert_allclose(left - right, [0.0, 0.3, 0.0], atol=0.005)
    assert left[0] > 0.3 and 0.2 < left[2] < 0.4, "before the chest"
    for name, angle in zip(JOINT_NAMES[ARM_JOINTS], HOLDING_ARMS, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_kinematics(model, data)
    for side, inwards in (("left", -1.0), ("right", 1.0)):
        normal = data.body(f"{side}_wrist_yaw_link").xmat.reshape(3, 3)[:, 1] * inwards
        assert normal @ np.array([0.0, inwards, 0.0]) > 0.99, "the palms face each other"
    assert np.isnan(palms_in_torso(np.full((1, 14), np.nan))).all()


# -- figures of scripted motions -----------------------------------------------------------------------------


def test_windows_hold_the_steps_that_end_in_them() -> None:
    trace = standing_trace(1.0)
    assert trace.steps(0.0, 0.1) == slice(0, 5) and trace.steps(0.1, 1.0) == slice(5, 50)


def test_feet_rest_unless_they_step() -> None:
    time = np.arange(1, 201) * PERIOD
    still = standing_trace(4.0)
    assert feet_rest(still, 2.0).tolist() == [True]

    def moved(axis: int, path: np.ndarray) -> Trace:
        trace = standing_trace(4.0)
        trace["foot_position"][0, :, 1, axis] += path
        return trace

    trembling = 0.004 * np.sign(np.sin(2.0 * np.pi * 12.5 * time))
    assert np.abs(np.diff(trembling)).max() / PERIOD > 0.3, "fast from step to step"
    assert feet_rest(moved(0, trembling), 2.0).all()
    step = 0.05 * np.sin(np.pi * ((time - 3.0) / 0.25).clip(0.0, 1.0))
    assert not feet_rest(moved(2, step), 2.0).any(), "a step on the spot"
    assert feet_rest(moved(2, step), 3.4).all(), "it was over by then"
    assert feet_rest(moved(0, 0.09 * time), 2.0).all() and not feet_rest(moved(0, 0.11 * time), 2.0).any()
    assert feet_rest(moved(0, np.minimum(time, 2.0)), 2.0).all(), "what came before does not count"
    assert not feet_rest(replace(still, fell=np.ones((1, 200), dtype=bool)), 2.0).any()


def test_drift_is_measured_between_two_instants_and_across_the_cut_of_the_heading() -> None:
    trace = standing_trace(4.0)
    trace["position"][0, :, 0] = 0.03 * np.arange(1, 201) * PERIOD
    trace["position"][0, :, 1] = -0.04 * np.arange(1, 201) * PERIOD
    trace["heading"][0, :100], trace["heading"][0, 100:] = 3.1, -3.1
    moved, turned = drift(trace, 1.0, 3.0)
    assert moved == pytest.approx([0.1]) and turned == pytest.approx([2.0 * np.pi - 6.2])


def test_palm_displacement_of_a_turned_wrist() -> None:
    """The palm lies 0.09 m from the axis of the wrist's yaw joint, so that turning it moves the palm along a chord."""
    unloaded = standing_trace(1.0, episodes=2)
    loaded = replace(unloaded, channels=unloaded.channels | {"arms": unloaded["arms"].copy()})
    wrist = JOINT_NAMES[ARM_JOINTS].index("left_wrist_yaw_joint")
    loaded["arms"][0, 25:, wrist] += 0.3
    loaded["arms"][1] = np.nan
    displacement = palm_displacement(loaded, unloaded, (0.5, 1.0))
    chord = 2.0 * PALM_OFFSET[0] * np.sin(0.15)
    assert displacement[0] == pytest.approx(0.5 * chord, rel=1e-6), "one hand of two"
    assert np.isnan(displacement[1])


def test_figures_of_scripted_traces() -> None:
    traces = {skill.name: standing_trace(skill.duration, episodes=4) for skill in SKILLS}
    bend = traces[DEEP_BEND.name]
    bend["height_error"][:, 100:350] = -0.02
    bend["height_error"][:, :100] = 0.4
    bend["pitch_error"][:, 350:] = -1.2
    bend["pitch_error"][1, 100:350] = np.tile([0.1, -0.1], 125)
    bend.fell[2:, -1] = True
    bend["height_error"][2, 225:] = np.nan
    bend["height_error"][3, 50:] = np.nan
    bend["pitch_error"][2, 225:] = bend["pitch_error"][3, 50:] = np.nan
    walk = traces[LOADED_WALK.name]
    walk["forward_speed"][:, 100:] = 0.4
    stop = traces[STOP.name]
    stop["position"][1, :, 0] = np.linspace(0.0, 0.32, stop["position"].shape[1])
    stop["heading"][2, -1] = 0.2
    stop["foot_position"][3, 400:, 0, 0] = 0.05
    figures = skill_figures(traces)
    assert set(figures) == set(SKILL_FIGURES)
    values = {name: figure.value for name, figure in figures.items()}
    assert values["deep_bend_success"] == 0.5 and values["push_success"] == 1.0
    assert values["deep_bend_height_error"] == pytest.approx(0.02), "absolute, while bent only"
    assert figures["deep_bend_height_error"].n == 3, "one fell before it was bent"
    assert values["deep_bend_pitch_error"] == pytest.approx(0.1 / 3)
    assert values["loaded_bend_palm_displacement"] == 0.0
    assert values["loaded_walk_speed"] == pytest.approx(0.4)
    assert values["stop_success"] == 0.25 and values["stop_rest"] == 0.75
    assert values["stop_drift"] == pytest.approx(0.25 * 0.32 * 500 / 799, rel=1e-6)
    assert values["stop_turn"] == pytest.approx(0.05)
    assert all(figure.ci95 is not None for figure in figures.values())


def test_a_trace_is_what_was_measured_and_ends_with_a_fall(controller: Controller) -> None:
    arena = Arena(controller, FLAT, num_threads=1, batch=2)
    skill = replace(PUSH, phases=(Phase(0.5),), push_times=())
    episodes = skill_episodes(skill, controller.command_space, 3, 0)
    episodes[0] = replace(episodes[0], pushes=(Push(0.0, (0.0, 12.0, 0.0)),))
    trace = record(arena, episodes, CHANNELS)
    assert trace.fell.any(axis=1).tolist() == [True, False, False]
    last = int(np.isfinite(trace["height_error"][0]).sum())
    assert 0 < last < 25, "twelve meters per second sideways fell nobody"
    for channel in trace.channels.values():
        assert np.isfinite(channel[0, :last]).all() and np.isnan(channel[0, last:]).all()
        assert np.isfinite(channel[1:]).all()
    moments = list(arena.run(episodes[2:]))
    assert len(moments) == 25
    for step, moment in enumerate(moments):
        robot = moment.measured.robot
        np.testing.assert_array_equal(trace["arms"][2, step], robot.joint_position[0, ARM_JOINTS])
        np.testing.assert_array_equal(trace["position"][2, step], robot.base_position[0, :2])
        assert trace["height_error"][2, step] == pytest.approx(robot.base_position[0, 2].item() - 0.76, abs=1e-3)


def test_the_box_pushes_the_palms_apart_and_down(controller: Controller) -> None:
    """The arms give way in the direction of the box's forces, and not before it is there."""
    arena = Arena(controller, FLAT, num_threads=1, batch=2)
    short = replace(LOADED_BEND, phases=(Phase(1.2),), measured=(1.0, 1.2), load=replace(BOX_LOAD, begin=0.5))
    loaded, unloaded = (
        record(arena, skill_episodes(skill, controller.command_space, 2, 0), CHANNELS)
        for skill in (short, replace(short, load=None))
    )
    assert not loaded.fell.any() and not unloaded.fell.any()
    np.testing.assert_array_equal(loaded["arms"][:, :25], unloaded["arms"][:, :25])
    with_load, without = (palms_in_torso(trace["arms"][:, -1]) for trace in (loaded, unloaded))
    moved = with_load - without
    assert (moved[:, 0, 1] > 0.01).all() and (moved[:, 1, 1] < -0.01).all(), "the left hand to the left"
    assert (moved[..., 2] < 0.0).all(), "both hands down"
    displacement = palm_displacement(loaded, unloaded, short.measured)
    assert ((displacement > 0.01) & (displacement < 0.15)).all()
