"""Constants of the nominal motion that :mod:`lowlevel.nominal` computes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class NominalConfig:
    """Nominal motion that the policy's action corrects."""

    kind: Literal["default", "pose", "march"] = "march"
    """``default``: legs and waist around the default pose; ``pose``: around the nominal-pose table;
    ``march``: the table plus a feed-forward march while walking."""
    gait_clock: bool = True
    """Show the gait clock to the policy (sine and cosine, zero while standing); an addition to the paper."""
    gait_frequency: float = 2.2
    """Steps of one foot per second [Hz]."""
    velocity_rate: float = 1.5
    """Slew rate of the velocity reference [m/s^2] and [rad/s^2]: steps go on until the robot has slowed down."""
    height_rate: float = 0.45
    """Slew rate of the base height reference [m/s]."""
    torso_rate: tuple[float, float, float] = (1.0, 1.0, 2.0)
    """Slew rates of the torso's roll, pitch and yaw reference [rad/s]; yaw hardly moves the centre of mass."""
    arm_rate: float = 5.0
    """Slew rate of the arm reference [rad/s]."""
    stopping_time: float = 1.5
    """A march outlasts a command to stop by this long per speed that was to be lost [s per m/s]; less than
    1 / velocity_rate: it ends with the velocity reference."""
    walking_ramp: float = 0.2
    """Time over which the march fades in and out [s]."""
    settling_time: float = 0.3
    """A robot told to stand keeps its posture until its march has been over for this long, and for this long from the
    start [s]; 0: it does not wait for the march either."""
    knee_lift: float = 0.72
    """Knee flexion at mid-swing [rad]; hip and ankle take half of it back."""
    soft_landing: bool = True
    """The foot comes to rest as it lands; False: it follows a sine and stamps down at 1 m/s."""
    lateral_shift: float = 0.044
    """Amplitude of the hip roll that moves the pelvis over the stance foot [rad]."""
    stride: tuple[float, float, float] = (0.15, 0.1, 0.14)
    """Hip swing per commanded vx, vy [rad per m/s] and yaw rate [rad per rad/s]. A foot that lands half a step ahead
    of the hip keeps the speed; one further ahead brakes."""
    stride_lead: float = 1.1
    """Phase by which the stride's targets lead the gait clock [rad]. The loaded hip follows about 0.8 rad late, and a
    foot that still swings forwards as it lands brakes the robot."""
    lift_lead: float = 0.05
    """The same for the lift of the feet [rad]."""
    capture_lead: float = -0.15
    """The same for capture steps [rad]."""
    creep: float = 0.14
    """Forward velocity of the march in place, which is taken back [m/s]."""
    side_step_turn: float = 0.1
    """Yaw rate added per commanded vy [rad/s per m/s]: stepping sideways turns the robot by as much."""
    swing_trim_rate: float = 0.3
    """Rate at which the waist takes up what of the yaw rate repeats with the gait, at its first three harmonics
    [rad/s per rad/s]; 0 switches that off."""
    swing_trim_lead: tuple[float, float, float] = (1.7, 0.35, 0.0)
    """Phase by which the turn of the waist leads the yaw rate that it takes back, at each harmonic [rad]. The pelvis
    answers with 5.8, 7.5 and 8.9 rad/s per rad at any speed and posture."""
    largest_swing_trim: float = 0.15
    """Most that the waist takes up in each part of each harmonic [rad]."""
    velocity_trim_rate: float = 0.7
    """Rate at which the march takes up a lasting error of the estimated velocity and the measured yaw rate
    [m/s^2 per m/s]; 0 switches that off."""
    velocity_trim_share: tuple[float, float] = (0.05, 0.3)
    """Most that it takes up in each component: a constant [m/s, rad/s], and a share of the commanded speed."""
    carry_arms: bool = True
    """Shift the pelvis against the arms' weight and bear its moment; False: as if the arms hung at their default."""
    largest_shift: float = 0.08
    """Largest such shift along x and along y [m]."""
    bear_arms: bool = True
    """Arm targets lead by what gravity would make the arms sag."""
    torso_trim_rate: float = 0.5
    """Rate at which waist roll and pitch take up a lasting torso error [rad/s per rad]; 0 switches that off."""
    largest_torso_trim: float = 0.2
    """Most that they take up [rad]."""
    gravity_gain: float = 0.12
    """Share of the measured gravity direction that the balance takes in at every control step; the gyroscope carries
    the rest on. 1: it balances on the measurement, whose noise shakes the hips."""
    rate_gain: float = 0.5
    """The same for the measured tilt rate, of which the rest is the one of the step before."""
    attitude_lag: float = 0.08
    """Time by which the pelvis lags behind its nominal attitude; the balance reckons with it [s]."""
    balance_stiffness: float = 3.1
    """Ankle correction per tilt of the pelvis off its nominal attitude [rad/rad]; 0 switches the strategy off."""
    balance_damping: float = 0.245
    """Ankle correction per tilt rate [rad per rad/s]."""
    step_stiffness: float = 1.85
    """While marching: hip correction per tilt [rad/rad]; the swing foot steps towards the fall, the stance hip
    rights the body."""
    step_damping: float = 0.23
    """Hip correction per tilt rate [rad per rad/s]; 0.27 s is the time constant of a 0.7 m inverted pendulum."""
    lean: tuple[float, float] = (0.125, 0.15)
    """Lean of the pelvis that counts as upright while walking, per commanded vx and vy [rad per m/s]: steps that
    chase it carry the robot along."""
    acceleration_lean: float = 1.0
    """Lean into starts, stops and turns, as a share of what a pendulum needs for their acceleration."""
    acceleration_time: float = 0.08
    """Time constant of that acceleration [s]."""
    largest_lean: float = 0.4
    """Largest lean along x and along y [rad]."""
    steady_time: float = 2.0
    """Time constant of the slow average of the tilt, which is no unbalance [s]; 0: all of it is."""
    stepping_threshold: float = 0.16
    """:attr:`NominalState.unbalance` from which a standing robot marches to catch itself [rad]."""
    stepping_time: float = 1.1
    """How long it then marches [s]."""
    stepping_height: float = 0.55
    """Lowest base height reference at which it does: a deep squat leaves the legs no room [m]."""
    stepping_torso: tuple[float, float, float] = (0.2, 0.5, 0.5)
    """Largest torso roll, pitch and yaw references at which it does [rad]."""
    recovery_threshold: float = 0.22
    """:attr:`NominalState.unbalance` from which a robot that stands in any posture does so, whether it rests or not; on
    the way it straightens up to where it can, and takes up its posture again once it has settled [rad]."""
    recovery_height: float = 0.6
    """Base height that it then rises to [m]."""

    def __post_init__(self) -> None:
        if self.attitude_lag < 0.0:
            raise ValueError(f"attitude_lag must not be negative, but it is {self.attitude_lag} s")
