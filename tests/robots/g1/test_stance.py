"""The stance solver: derivatives by finite differences, geometry by hand, verdicts on bad postures."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from robots.g1.constants import TOTAL_MASS
from robots.g1.stance import COM_MARGIN, STANCE_HALF_WIDTH, StanceSolver, support_margin


@pytest.fixture(scope="module")
def solver() -> StanceSolver:
    return StanceSolver()


def test_jacobian_equals_finite_differences(solver: StanceSolver) -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        posture = rng.uniform([0.3, -0.4, -0.3, -1.5], [0.76, 0.4, 1.5, 1.5])
        unknowns = np.concatenate([rng.uniform(-0.3, 0.3, 4), rng.uniform(solver.lower_limit, solver.upper_limit)])
        _, jacobian = solver._residual(posture, unknowns)
        step = 1e-6
        numeric = np.column_stack(
            [
                solver._residual(posture, unknowns + step * unit)[0]
                - solver._residual(posture, unknowns - step * unit)[0]
                for unit in np.eye(19)
            ]
        ) / (2 * step)
        np.testing.assert_allclose(jacobian, numeric, atol=1e-5 * np.abs(jacobian).max())


@pytest.mark.parametrize(
    ("point", "margin"),
    [
        ((0.0, 0.0), 0.05),  # the heels are 5 cm behind the ankles
        ((0.1, 0.0), 0.02),  # the toes 12 cm ahead
        ((0.2, 0.0), -0.08),
        # At the side: the edge from heel (-0.05, 0.145) to toe (0.12, 0.15) is 0.17 long and opens by 0.005.
        ((0.035, 0.1375), 0.01 * 0.17 / np.hypot(0.17, 0.005)),
        ((0.035, -0.1575), -0.01 * 0.17 / np.hypot(0.17, 0.005)),
    ],
)
def test_support_margin_by_hand(point: tuple[float, float], margin: float) -> None:
    assert STANCE_HALF_WIDTH == 0.12
    assert support_margin(np.array(point)) == pytest.approx(margin, abs=1e-9)


@pytest.mark.parametrize(
    "posture", [(0.74, 0.0, 0.0, 0.0), (0.5, 0.2, 0.6, 0.7), (0.38, 0.0, 1.2, 0.0), (0.35, 0.0, 1.0, 0.0)]
)
def test_solved_posture_is_the_one_asked_for(solver: StanceSolver, posture: tuple[float, ...]) -> None:
    stance = solver.solve(np.array(posture))
    assert stance.is_sound()
    unknowns, reached = solver.place(stance.joints)
    np.testing.assert_allclose(reached, posture, atol=1e-3)
    np.testing.assert_allclose(unknowns, stance.unknowns, atol=1e-3)


@pytest.mark.parametrize(
    "posture",
    [
        (0.9, 0.0, 0.0, 0.0),  # higher than the legs are long
        (0.3, 0.0, 1.5, 0.0),  # past the hips' limit
        (0.76, 0.0, 1.5, 0.0),  # legs too short to bend over from this height
    ],
)
def test_impossible_posture_is_not_sound(solver: StanceSolver, posture: tuple[float, ...]) -> None:
    stance = solver.solve(np.array(posture))
    assert np.isfinite(stance.unknowns).all()
    assert not stance.is_sound()


def test_balance_and_torques_of_a_squat(solver: StanceSolver) -> None:
    """Moments by hand: each ankle carries half of the weight at the lever of the center of mass."""
    stance = solver.solve(np.array([0.5, 0.0, 0.3, 0.0]))
    com_x = pin.centerOfMass(solver.model, solver.data, solver.configuration(0.5, stance.unknowns))[0]
    weight = TOTAL_MASS * 9.81
    feet_mass = solver.model.inertias[solver.model.getJointId("left_ankle_roll_joint")].mass * 2
    assert stance.com_margin >= COM_MARGIN
    for ankle_pitch in (4, 10):
        # The foot's own weight does not load its ankle; it acts 4 cm ahead of it at most.
        lever_tolerance = feet_mass / 2 * 9.81 * 0.04
        assert stance.torques[ankle_pitch] == pytest.approx(weight / 2 * com_x, abs=lever_tolerance)
