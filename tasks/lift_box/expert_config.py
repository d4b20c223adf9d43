"""How the scripted expert moves, as data: its phases and its constants.

The numbers follow OmniContact's reference generator and DemoHLM's three segments (walk, reach in the object's frame,
lift in the robot's frame).
"""

from __future__ import annotations

from dataclasses import dataclass

WALK, STOP, DESCEND, CLOSE, LIFT, HOLD = range(6)


@dataclass(frozen=True)
class ExpertConfig:
    """How the expert moves."""

    stand_off: float = 0.27
    """Near face ahead of the feet when the walk ends [m]: clear of the knees of a deep squat."""
    gate_distance: float = 0.70
    """Near face ahead of the feet at the gate in front of the box, where it lines up [m]."""
    gate_lateral: float = 0.15
    """Lateral error beyond which it goes to the gate before it goes to the box [m]."""
    position_gain: float = 1.2
    """[1/s]"""
    yaw_gain: float = 1.6
    """[1/s]"""
    slowest: float = 0.14
    """Least speed while walking [m/s]: the controller ignores slower commands."""
    position_tolerance: float = 0.04
    """Along the box's x axis [m]."""
    lateral_tolerance: float = 0.07
    """Along its y axis, where the arms make up for the rest [m]."""
    yaw_tolerance: float = 0.09
    """[rad]"""
    loose: float = 1.5
    """Tolerances grow by this factor once it stands, before it walks again."""
    settle_time: float = 0.5
    """Standing time before the descent [s]."""
    descend_time: float = 2.0
    """[s]"""
    clearance: float = 0.07
    """Of each palm from its face before the grasp [m]."""
    palm_ahead: float = 0.025
    """Of the palms' targets from the middle of the side faces [m]: the arms end up short of them by as much."""
    finger_pitch: float = 0.85
    """Fingers point down by this much [rad]."""
    toe_in: float = 0.12
    """Fingers point at each other by this much, so that forearms stay clear of the faces [rad]."""
    toe_in_per_depth: float = 3.5
    """More of it per squeeze depth [rad/m]: the wrists give way, and the palms must not open."""
    level_gain: float = 0.03
    """Share of the box's pitch that the fingers take back at every decision while it is carried."""
    largest_level: float = 0.6
    """[rad]"""
    wide: float = 0.06
    """Extra clearance of each palm while the body descends [m]."""
    reach_length: float = 0.42
    """Largest distance of a palm from its shoulder while the body descends [m]."""
    ready_tolerance: float = 0.06
    """Of the palms from their pre-grasp places before they close [m]."""
    close_speed: float = 0.12
    """Of each palm towards its face [m/s]."""
    force: float = 30.0
    """Wanted normal force per palm [N]."""
    force_gain: float = 0.0016
    """Squeeze depth per force error and decision [m/N]."""
    deepest: float = 0.095
    """Largest squeeze depth [m]."""
    grasp_time: float = 0.5
    """Time with both palms loaded before the lift [s]."""
    lift_time: float = 3.2
    """[s]"""
    carry_ahead: float = 0.34
    """Of the palms from the feet when upright [m]."""
    carry_height: float = 0.74
    """Least height of the palms when upright [m]."""
    carry_clearance: float = 0.38
    """Least bottom of the box above its support when upright [m]."""
    raise_gain: float = 0.08
    """Share of the missing clearance that the palms rise by at every decision once upright; the arms give way."""
    largest_raise: float = 0.2
    """[m]"""
    stand_height: float = 0.75
    """[m]"""
    pitch_filter: float = 0.2
    """Share of the torso's pitch error that the arms take in at every decision during the lift."""
    hold_filter: float = 0.05
    """The same while the box is held."""
    correction_gain: float = 0.25
    """Share of the palms' position error that is added to the correction at every decision."""
    largest_correction: float = 0.08
    """[m]"""
