"""Every nominal pose that a clamped command can ask for stands: feet flat, balanced, within effort.

Poses are judged with MuJoCo, the table is computed with Pinocchio. Grid nodes hold the solver's tolerances.
Between nodes joints are interpolated, and the feet are then flat only nearly; the tolerances say how nearly.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from robots.errors import PilotError
from robots.g1.constants import DEFAULT_POSITION, LOWER_JOINTS, SOLE_OFFSET, TORSO_BODY
from robots.g1.mirror import LOWER_MIRROR
from robots.g1.model import ModelOptions, build_spec, effort_limits
from robots.g1.nominal_pose import PATH, NominalPose
from robots.g1.nominal_pose_solver import ROLL, fill_unsound
from robots.g1.stance import COM_MARGIN, LIMIT_MARGIN, STANCE_HALF_WIDTH, StanceSolver

LOWEST = np.array([0.30, -0.4, -0.3, -1.5])
HIGHEST = np.array([0.76, 0.4, 1.5, 1.5])
"""The paper's ranges of height [m], roll, pitch and yaw [rad]."""

DIRECTIONS = np.stack([np.cos(np.linspace(0, 2 * np.pi, 721)), np.sin(np.linspace(0, 2 * np.pi, 721))], axis=1)


@dataclass(frozen=True)
class Verdict:
    """What MuJoCo says of one pose that stands on its left foot."""

    foot_error: float
    """Largest displacement [m] or rotation-matrix entry of the right foot from flat at its place."""
    height: float
    torso_error: float
    com_margin: float
    imbalance: float
    """Greatest torque or force that gravity, contact forces and the table's torques leave over [N m, N]."""
    contacts: set[tuple[str, str]]


class Judge:
    """Stands poses on the ground in MuJoCo and measures them."""

    def __init__(self) -> None:
        self.model = build_spec(ModelOptions(floor=False)).compile()
        self.data = mujoco.MjData(self.model)
        self.spheres = [f"{side}_foot_{number}" for side in ("left", "right") for number in range(4)]
        self.limits = self.model.jnt_range[1:][LOWER_JOINTS]
        self.effort = effort_limits(self.model)[LOWER_JOINTS]

    def stand(self, joints: np.ndarray, arms: np.ndarray = DEFAULT_POSITION[15:]) -> None:
        """Put the left foot flat at its place; the rest follows from the joints."""
        model, data = self.model, self.data
        data.qpos[:] = 0.0
        data.qpos[3] = 1.0
        data.qpos[7:22], data.qpos[22:] = joints, arms
        mujoco.mj_kinematics(model, data)
        foot = data.body("left_ankle_roll_link")
        inverse = np.empty(4)
        mujoco.mju_negQuat(inverse, foot.xquat)
        offset = np.empty(3)
        mujoco.mju_rotVecQuat(offset, foot.xpos, inverse)
        data.qpos[:3] = np.array([0.0, STANCE_HALF_WIDTH, -SOLE_OFFSET]) - offset
        data.qpos[3:7] = inverse
        mujoco.mj_forward(model, data)

    def verdict(self, posture: np.ndarray, joints: np.ndarray, torques: np.ndarray) -> Verdict:
        self.stand(joints)
        data = self.data
        foot = data.body("right_ankle_roll_link")
        place = np.array([0.0, -STANCE_HALF_WIDTH, -SOLE_OFFSET])
        foot_error = max(np.abs(foot.xpos - place).max(), np.abs(foot.xmat.reshape(3, 3) - np.eye(3)).max())
        pelvis = data.body("pelvis").xmat.reshape(3, 3)
        yaw = np.arctan2(pelvis[1, 0], pelvis[0, 0])
        wanted = np.eye(3)
        for angle, axis in zip((yaw + posture[3], posture[2], posture[1]), (2, 1, 0), strict=True):
            wanted = wanted @ _rotation(axis, angle)
        torso = data.body(TORSO_BODY).xmat.reshape(3, 3)
        points = np.array([data.geom(name).xpos[:2] for name in self.spheres])
        reach = (points @ DIRECTIONS.T).max(axis=0)
        return Verdict(
            foot_error=float(foot_error),
            height=float(data.qpos[2]),
            torso_error=float(np.abs(wanted - torso).max()),
            com_margin=float((reach - DIRECTIONS @ data.subtree_com[0][:2]).min()),
            imbalance=self._imbalance(torques),
            contacts=self.contacts(),
        )

    def _imbalance(self, torques: np.ndarray) -> float:
        # Contact forces on the soles are free: whatever they cannot explain of gravity is out of balance.
        model, data = self.model, self.data
        rows = []
        for name in self.spheres:
            jacobian = np.empty((3, model.nv))
            point = data.geom(name).xpos - np.array([0.0, 0.0, 0.005])
            mujoco.mj_jac(model, data, jacobian, None, point, model.geom(name).bodyid[0])
            rows.append(jacobian[:, :21])
        needed = data.qfrc_bias[:21].copy()
        needed[6:] -= torques
        contact = np.vstack(rows).T
        forces = np.linalg.lstsq(contact, needed, rcond=None)[0]
        return float(np.abs(contact @ forces - needed).max())

    def contacts(self) -> set[tuple[str, str]]:
        """Pairs of geoms that touch."""
        names = ((self.model.geom(a).name, self.model.geom(b).name) for a, b in self.data.contact.geom)
        return {(min(pair), max(pair)) for pair in names}


def _rotation(axis: int, angle: float) -> np.ndarray:
    matrix, quaternion = np.empty(9), np.empty(4)
    mujoco.mju_axisAngle2Quat(quaternion, np.eye(3)[axis], angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def _is_arm(geom: str) -> bool:
    return "palm" in geom or "elbow" in geom


@pytest.fixture(scope="module")
def judge() -> Judge:
    return Judge()


@pytest.fixture(scope="module")
def poses() -> NominalPose:
    return NominalPose.load()


@pytest.fixture(scope="module")
def table() -> dict[str, np.ndarray]:
    with np.load(PATH, allow_pickle=False) as file:
        return dict(file)


def random_postures(count: int, seed: int = 0) -> torch.Tensor:
    """Uniform in the paper's ranges, a third of them far outside, (count, 4)."""
    rng = np.random.default_rng(seed)
    postures = rng.uniform(LOWEST, HIGHEST, size=(count, 4))
    postures[::3] += rng.normal(size=postures[::3].shape)
    return torch.tensor(postures, dtype=torch.float32)


def test_paper_range_is_the_grid(table: dict[str, np.ndarray]) -> None:
    axes = [table[name] for name in ("height", "roll", "pitch", "yaw")]
    np.testing.assert_allclose([axis[0] for axis in axes], LOWEST, atol=1e-6)
    np.testing.assert_allclose([axis[-1] for axis in axes], HIGHEST, atol=1e-6)
    assert PATH.stat().st_size < 4e6


def test_lookup_returns_the_nodes(poses: NominalPose, table: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(0)
    nodes = np.stack([rng.integers(size, size=200) for size in table["sound"].shape], axis=1)
    axes = [table[name] for name in ("height", "roll", "pitch", "yaw")]
    posture = np.stack([axis[nodes[:, k]] for k, axis in enumerate(axes)], axis=1)
    positions, torques = poses.lookup(torch.tensor(posture))
    np.testing.assert_allclose(positions, table["positions"][tuple(nodes.T)], atol=1e-4)
    np.testing.assert_allclose(torques, table["torques"][tuple(nodes.T)], atol=5e-3)


def test_lookup_interpolates_axis_by_axis(poses: NominalPose, table: dict[str, np.ndarray]) -> None:
    """Against one-dimensional interpolation along one axis after the other, also outside the grid."""
    postures = random_postures(8)
    expected = []
    for posture in postures.numpy():
        values = np.concatenate([table["positions"], table["torques"]], axis=-1)
        for name, coordinate in zip(("height", "roll", "pitch", "yaw"), posture, strict=True):
            flat = values.reshape(len(values), -1)
            columns = [np.interp(coordinate, table[name], flat[:, k]) for k in range(flat.shape[1])]
            values = np.array(columns).reshape(values.shape[1:])
        expected.append(values)
    positions, torques = poses.lookup(postures)
    np.testing.assert_allclose(torch.cat([positions, torques], dim=1), expected, atol=1e-3)


def test_lookup_and_clamp_are_per_robot(poses: NominalPose) -> None:
    postures = random_postures(64)
    for function in (lambda p: torch.cat([part.flatten(1) for part in poses.lookup(p)], dim=1), poses.clamp):
        together = function(postures)
        one_by_one = torch.cat([function(posture[None]) for posture in postures])
        torch.testing.assert_close(together, one_by_one, atol=1e-5, rtol=0.0)
    assert poses.clamp(postures[:0]).shape == (0, 4)


def test_clamp_is_idempotent_and_bounded(poses: NominalPose) -> None:
    postures = random_postures(20000)
    clamped = poses.clamp(postures)
    torch.testing.assert_close(poses.clamp(clamped), clamped, atol=0.0, rtol=0.0)
    assert (clamped >= torch.tensor(LOWEST - 1e-6)).all() and (clamped <= torch.tensor(HIGHEST + 1e-6)).all()
    inside = ((postures >= torch.tensor(LOWEST)) & (postures <= torch.tensor(HIGHEST))).all(dim=1)
    unchanged = (clamped == postures).all(dim=1)
    assert not unchanged[~inside].any()
    # Measured: 73 % of the paper's box can be held; the rest are corners such as bending over while tall.
    assert unchanged[inside].float().mean() > 0.7
    # Height and yaw are only ever brought into their range.
    torch.testing.assert_close(clamped[:, 0], postures[:, 0].clamp(0.30, 0.76))
    torch.testing.assert_close(clamped[:, 3], postures[:, 3].clamp(-1.5, 1.5))


def test_clamp_keeps_what_the_task_needs(poses: NominalPose) -> None:
    kept: list[tuple[float, ...]] = [
        (0.38, 0, 1.2, 0),
        (0.35, 0, 1.0, 0),
        (0.30, 0, 1.2, 0),
        (0.30, 0, 0, 0),
        (0.50, 0, 1.5, 0),
        *((0.74, roll, 0, yaw) for roll in (-0.4, 0.4) for yaw in (-1.5, 1.5)),
        (0.76, 0, 0, 0),
    ]
    postures = torch.tensor(kept, dtype=torch.float32)
    torch.testing.assert_close(poses.clamp(postures), postures, atol=1e-6, rtol=0.0)


def test_clamp_moves_continuously(poses: NominalPose) -> None:
    """A small move of the command moves the clamped one little: nothing jumps at a cell's border.

    The steepest limit changes by 0.6 rad of pitch over 0.038 m of height, that is 15.7 rad/m.
    """
    postures = random_postures(20000)
    nudge = 1e-3 * torch.nn.functional.normalize(torch.randn(20000, 4, generator=torch.Generator().manual_seed(0)))
    moved = (poses.clamp(postures + nudge) - poses.clamp(postures)).abs().max()
    assert moved < 0.020


def test_mirrored_posture_gives_the_mirrored_pose(poses: NominalPose) -> None:
    postures = random_postures(2000)
    flip = torch.tensor([1.0, -1.0, 1.0, -1.0])
    for values, mirrored in zip(poses.lookup(postures)[:2], poses.lookup(postures * flip)[:2], strict=True):
        np.testing.assert_allclose(mirrored, LOWER_MIRROR(values.numpy()), atol=2e-4)
    torch.testing.assert_close(poses.clamp(postures * flip), poses.clamp(postures) * flip, atol=1e-6, rtol=0.0)


def test_sound_nodes_stand(judge: Judge, table: dict[str, np.ndarray]) -> None:
    """Every sound node of one half of the grid; the other half mirrors it."""
    sound = table["sound"].copy()
    assert (sound == sound[:, ::-1, :, ::-1]).all()
    assert np.isfinite(table["positions"]).all() and np.isfinite(table["torques"]).all()
    sound[:, : len(ROLL) // 2] = False
    nodes = np.argwhere(sound)
    assert len(nodes) > 9000
    lower, upper = judge.limits.T
    for node in nodes[np.random.default_rng(0).permutation(len(nodes))]:
        axes = ("height", "roll", "pitch", "yaw")
        posture = np.array([table[name][index] for name, index in zip(axes, node, strict=True)])
        joints, torques = table["positions"][tuple(node)], table["torques"][tuple(node)]
        verdict = judge.verdict(posture, joints, torques)
        assert verdict.foot_error < 2e-3, posture
        assert verdict.height == pytest.approx(posture[0], abs=2e-3)
        assert verdict.torso_error < 2e-3, posture
        assert verdict.com_margin >= COM_MARGIN - 1e-3, posture  # the feet may be 1 mm off
        assert verdict.imbalance < 0.1, posture
        assert (np.abs(torques) <= judge.effort).all()
        assert (joints >= lower + LIMIT_MARGIN - 1e-6).all() and (joints <= upper - LIMIT_MARGIN + 1e-6).all()
        assert all(_is_arm(a) or _is_arm(b) for a, b in verdict.contacts), posture


def test_clamped_postures_stand(judge: Judge, poses: NominalPose) -> None:
    """Between the nodes, for any command: what remains of feet, balance and height after interpolation."""
    postures = poses.clamp(random_postures(3000, seed=1))
    positions, torques = poses.lookup(postures)
    cases = zip(postures.numpy(), positions.numpy(), torques.numpy(), strict=True)
    verdicts = [judge.verdict(*case) for case in cases]
    foot_errors = np.array([verdict.foot_error for verdict in verdicts])
    assert np.percentile(foot_errors, 99) < 0.01  # measured 0.0053
    assert foot_errors.max() < 0.05  # measured 0.017 here, 0.040 over other seeds
    assert max(verdict.torso_error for verdict in verdicts) < 0.03  # measured 0.012
    heights = [abs(verdict.height - float(posture[0])) for verdict, posture in zip(verdicts, postures, strict=True)]
    assert max(heights) < 0.01  # measured 0.004
    assert min(verdict.com_margin for verdict in verdicts) >= COM_MARGIN  # measured 0.0206
    assert max(verdict.imbalance for verdict in verdicts) < 1.0  # measured 0.21
    assert (torques.abs().numpy() <= judge.effort).all()
    lower, upper = judge.limits.T
    assert (positions.numpy() > lower + LIMIT_MARGIN).all() and (positions.numpy() < upper - LIMIT_MARGIN).all()
    assert not any(not (_is_arm(a) or _is_arm(b)) for verdict in verdicts for a, b in verdict.contacts)


@pytest.mark.parametrize(("roll", "yaw"), [(0.0, 0.3), (0.1, 0.2)])
def test_default_arms_keep_clear_of_the_legs_when_facing_ahead(
    judge: Judge, poses: NominalPose, roll: float, yaw: float
) -> None:
    """With the torso turned further the arms must follow: at their default, a hand then meets a thigh."""
    postures = random_postures(500, seed=2)
    postures[:, 1], postures[:, 3] = postures[:, 1].clamp(-roll, roll), postures[:, 3].clamp(-yaw, yaw)
    for joints in poses.lookup(poses.clamp(postures))[0].numpy():
        judge.stand(joints)
        assert not judge.contacts()


def test_spread_arms_keep_clear_of_the_legs_everywhere(judge: Judge, poses: NominalPose) -> None:
    """So no posture is ruled out by self-collision: shoulders rolled outwards by 0.8 rad are enough."""
    arms = DEFAULT_POSITION[15:].copy()
    arms[[1, 8]] = 0.8, -0.8
    for joints in poses.lookup(poses.clamp(random_postures(500, seed=3)))[0].numpy():
        judge.stand(joints, arms)
        assert not judge.contacts()


def test_table_is_what_the_solver_computes(table: dict[str, np.ndarray]) -> None:
    solver, rng = StanceSolver(), np.random.default_rng(0)
    nodes = np.argwhere(table["sound"])
    for node in nodes[rng.choice(len(nodes), size=50, replace=False)]:
        axes = ("height", "roll", "pitch", "yaw")
        posture = np.array([table[name][index] for name, index in zip(axes, node, strict=True)], dtype=float)
        joints = table["positions"][tuple(node)].astype(float)
        stance = solver.solve(posture, solver.place(joints)[0])
        np.testing.assert_allclose(stance.joints, joints, atol=2e-3)
        np.testing.assert_allclose(stance.torques, table["torques"][tuple(node)], atol=0.1)


def test_unsound_nodes_hold_a_sound_neighbor(table: dict[str, np.ndarray]) -> None:
    values = np.full(table["positions"].shape, np.nan)
    values[table["sound"]] = table["positions"][table["sound"]]
    fill_unsound(values, table["sound"])
    np.testing.assert_array_equal(values, table["positions"])


@pytest.mark.parametrize("damage", ["missing", "truncated", "text", "incomplete", "not finite", "wrong shape"])
def test_bad_table_is_refused(tmp_path: Path, table: dict[str, np.ndarray], damage: str) -> None:
    path = tmp_path / "table.npz"
    error: type[Exception] = ValueError
    arrays = dict(table)
    if damage == "missing":
        error = PilotError
    elif damage == "truncated":
        path.write_bytes(PATH.read_bytes()[:100_000])
    elif damage == "text":
        path.write_text("not a table")
    else:
        if damage == "incomplete":
            del arrays["torques"]
        elif damage == "not finite":
            arrays["positions"] = arrays["positions"].copy()
            arrays["positions"][3, 2, 1, 0, 5] = np.nan
        else:
            arrays["pitch_limits"] = arrays["pitch_limits"][1:]
        np.savez(path, **arrays)  # type: ignore[arg-type]
    with pytest.raises(error, match="nominal_pose_solver"):
        NominalPose.load(path=path)


def test_lookups_do_not_need_pinocchio() -> None:
    code = "import robots.g1.nominal_pose, sys; sys.exit('pinocchio' in sys.modules or 'mujoco' in sys.modules)"
    root = Path(__file__).parents[3]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0
