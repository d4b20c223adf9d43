"""Computes the nominal-pose table that :class:`robots.g1.nominal_pose.NominalPose` reads.

``python -m robots.g1.nominal_pose_solver`` regenerates the file in the package.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from robots.g1.mirror import LOWER_MIRROR
from robots.g1.nominal_pose import PATH
from robots.g1.stance import Stance, StanceSolver

HEIGHT = np.linspace(0.30, 0.76, 13)
ROLL = np.linspace(-0.4, 0.4, 9)
PITCH = np.linspace(-0.3, 1.5, 13)
YAW = np.linspace(-1.5, 1.5, 13)
"""Grid of the table: pelvis height [m] and torso attitude [rad]; roll and yaw are symmetric about zero."""

SHAPE = (len(HEIGHT), len(ROLL), len(PITCH), len(YAW))
_CENTRE = (len(HEIGHT) - 2, len(ROLL) // 2, int(np.abs(PITCH).argmin()), len(YAW) // 2)

ANCHOR_PITCH = (0.15, 0.6)
"""Torso pitches [rad] that stay available at every height and yaw: roll is limited where they would not."""
INTERPOLATION_TOLERANCE = 0.02
"""Greatest error of feet, torso and pelvis height midway between the nodes [m and rad]."""


def _posture(node: tuple[int, ...]) -> np.ndarray:
    return np.array([axis[i] for axis, i in zip((HEIGHT, ROLL, PITCH, YAW), node, strict=True)])


def _inward_neighbors(node: tuple[int, ...]) -> list[tuple[int, ...]]:
    neighbors = []
    for axis, (index, center) in enumerate(zip(node, _CENTRE, strict=True)):
        if index != center:
            step = 1 if index < center else -1
            neighbors.append((*node[:axis], index + step, *node[axis + 1 :]))
    return neighbors


def solve_grid(solver: StanceSolver) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joint positions, gravity torques (*SHAPE, 15) [rad, N m] and soundness (*SHAPE,) of every node.

    Each node starts from a neighbor nearer to standing. Half of the grid is solved and the other half
    mirrored; the robot's own small asymmetry (0.1 mm in its center of mass) is thereby left out of the table.
    """
    _, roll, _, yaw = np.indices(SHAPE, sparse=True)
    straight = np.broadcast_to((roll == _CENTRE[1]) & (yaw == _CENTRE[3]), SHAPE)
    to_solve = straight | (roll > _CENTRE[1]) | ((roll == _CENTRE[1]) & (yaw > _CENTRE[3]))
    nodes = [tuple(map(int, node)) for node in np.argwhere(to_solve)]
    nodes.sort(key=lambda node: sum(abs(i - c) for i, c in zip(node, _CENTRE, strict=True)))
    stances: dict[tuple[int, ...], Stance] = {}
    for node in nodes:
        solved = [stances[neighbor] for neighbor in _inward_neighbors(node) if neighbor in stances]
        solved.sort(key=lambda stance: not stance.is_sound())
        starts: list[np.ndarray | None] = [stance.unknowns for stance in solved]
        for start in starts or [None]:
            stances[node] = solver.solve(_posture(node), start)
            if straight[node]:
                stances[node] = _symmetric(solver, _posture(node), stances[node])
            if stances[node].is_sound():
                break
    positions, torques = np.empty((*SHAPE, 15)), np.empty((*SHAPE, 15))
    sound = np.zeros(SHAPE, dtype=bool)
    for node, stance in stances.items():
        positions[node], torques[node], sound[node] = stance.joints, stance.torques, stance.is_sound()
    for array in (positions, torques):
        array[~to_solve] = LOWER_MIRROR(array[:, ::-1, :, ::-1][~to_solve])
    sound[~to_solve] = sound[:, ::-1, :, ::-1][~to_solve]
    return positions, torques, sound


def _symmetric(solver: StanceSolver, posture: np.ndarray, stance: Stance) -> Stance:
    """The stance halfway between ``stance`` and its mirror image, for a posture without roll and yaw."""
    unknowns = stance.unknowns.copy()
    unknowns[1:3] = 0.0  # y and roll of the pelvis
    unknowns[4:] = (stance.joints + LOWER_MIRROR(stance.joints)) / 2.0
    symmetric = solver.evaluate(posture, unknowns)
    return replace(symmetric, torques=(symmetric.torques + LOWER_MIRROR(symmetric.torques)) / 2.0)


def safe_cells(solver: StanceSolver, positions: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Which grid cells are safe to interpolate in, each axis one shorter than SHAPE.

    All corners must be sound, and so must be the stance in the middle, within
    :data:`INTERPOLATION_TOLERANCE`.
    """
    corners = list(itertools.product((0, 1), repeat=4))
    safe = np.zeros(tuple(size - 1 for size in SHAPE), dtype=bool)
    for cell in np.ndindex(safe.shape):
        around = [tuple(np.add(cell, corner)) for corner in corners]
        if cell[1] < safe.shape[1] // 2 or not all(sound[node] for node in around):
            continue
        wanted = np.mean([_posture(node) for node in around], axis=0)
        unknowns, reached = solver.place(np.mean([positions[node] for node in around], axis=0))
        stance = solver.evaluate(reached, unknowns)
        close = np.abs(reached - wanted).max() < INTERPOLATION_TOLERANCE
        safe[cell] = close and stance.is_sound(INTERPOLATION_TOLERANCE)
    half = safe.shape[1] // 2
    safe[:, :half] = safe[:, : half - 1 : -1, :, ::-1]
    return safe


def command_limits(safe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roll limit (height, |yaw|) and pitch limits (height, |roll|, |yaw|, 2) that keep to safe cells [rad].

    Limits are the same for both signs of roll and of yaw. Each node takes the tightest limits of the cells
    around it; what is interpolated between nodes is then within the limits of the cell it lies in.
    """
    both = safe & safe[:, :, :, ::-1]
    cells = both[:, safe.shape[1] // 2 :, :, safe.shape[3] // 2 :]
    heights, rolls, _, yaws = cells.shape
    available = np.zeros((heights, yaws), dtype=int)
    pitches = np.empty((heights, rolls, yaws, 2))
    for h, y in np.ndindex(heights, yaws):
        for r in range(rolls):
            first, last = _longest_run(cells[h, r, :, y])
            lower, upper = PITCH[first], PITCH[last + 1]
            if lower > ANCHOR_PITCH[0] + 1e-9 or upper < ANCHOR_PITCH[1] - 1e-9:
                break
            available[h, y] = r + 1
            pitches[h, r, y] = lower, upper
    roll_limit = np.empty((heights + 1, yaws + 1))
    pitch_limits = np.empty((heights + 1, rolls + 1, yaws + 1, 2))
    for h, y in np.ndindex(roll_limit.shape):
        around = [cell for cell in itertools.product((h - 1, h), (y - 1, y)) if _inside(cell, available.shape)]
        roll_limit[h, y] = ROLL[_CENTRE[1] + min(available[cell] for cell in around)]
        for r in range(rolls + 1):
            touching = [pitches[i, j, k] for i, k in around for j in (r - 1, r) if 0 <= j < available[i, k]]
            if touching:
                pitch_limits[h, r, y] = max(p[0] for p in touching), min(p[1] for p in touching)
            elif r > 0:  # beyond the roll limit: never reached, but kept finite
                pitch_limits[h, r, y] = pitch_limits[h, r - 1, y]
            else:
                raise RuntimeError(f"no pitch is available at height {HEIGHT[h]:.2f} m even without roll")
    return roll_limit, pitch_limits


def _inside(index: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    return all(0 <= i < size for i, size in zip(index, shape, strict=True))


def _longest_run(flags: np.ndarray) -> tuple[int, int]:
    """First and last index of the longest run of True in ``flags``; (0, -1) if there is none."""
    best, start = (0, -1), 0
    for index, flag in enumerate(flags):
        if not flag:
            start = index + 1
        elif index - start > best[1] - best[0]:
            best = (start, index)
    return best


def fill_unsound(values: np.ndarray, sound: np.ndarray) -> None:
    """Overwrite unsound nodes of ``values`` (*SHAPE, 15): by the nearest sound pitch or a smaller roll."""
    half = _CENTRE[1]
    indices = np.arange(len(PITCH))
    for r in sorted(range(len(ROLL)), key=lambda r: abs(r - half)):
        for h, y in np.ndindex(len(HEIGHT), len(YAW)):
            usable = np.flatnonzero(sound[h, r, :, y])
            if len(usable) > 0:
                nearest = usable[np.abs(indices[:, None] - usable[None, :]).argmin(axis=1)]
                values[h, r, :, y] = values[h, r, nearest, y]
            else:
                values[h, r, :, y] = values[h, r + (1 if r < half else -1), :, y]


def generate(path: Path = PATH) -> None:
    """Compute the table and write it to ``path``."""
    solver = StanceSolver()
    positions, torques, sound = solve_grid(solver)
    safe = safe_cells(solver, positions, sound)
    roll_limit, pitch_limits = command_limits(safe)
    fill_unsound(positions, sound)
    fill_unsound(torques, sound)
    np.savez_compressed(
        path,
        height=HEIGHT.astype(np.float32),
        roll=ROLL.astype(np.float32),
        pitch=PITCH.astype(np.float32),
        yaw=YAW.astype(np.float32),
        positions=positions.astype(np.float32),
        torques=torques.astype(np.float32),
        sound=sound,
        roll_limit=roll_limit.astype(np.float32),
        pitch_limits=pitch_limits.astype(np.float32),
    )
    print(f"{sound.mean():.1%} of {sound.size} postures are sound, {safe.mean():.1%} of the cells safe")


if __name__ == "__main__":
    began = time.perf_counter()
    generate()
    print(f"{PATH} written in {time.perf_counter() - began:.0f} s")
