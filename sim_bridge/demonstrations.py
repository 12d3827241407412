# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Demonstrations of scripts that act as unsteadily as a person who teleoperates.

Speed, a detour before the script begins, pauses and noise are drawn from a seed, as the scene is.
A camera beside the robot and the commands are recorded: what a user has of another's robot.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from sim_bridge.world.gap import FAR
from sim_bridge.world.protocol import Observation
from tap_ros.recording.episode import Episode

MOST_FRAMES, LEAST_FRAMES = 70, 12
TRIES = 20  # a demonstration that fails is made anew
SPEED, NOISE = (0.45, 1.0), (0.0, 0.15)  # shares of the script's own command
DETOUR_SHARE, DETOUR_FRAMES = 0.8, 15  # of demonstrations; at most
DETOUR_LOW, DETOUR_HIGH = (-0.2, -0.1, -0.05), (0.2, 0.2, 0.2)  # m, from where the hand is
REACHED = 0.04  # m
PAUSES, PAUSE_FRAMES, PAUSE_RANGE = (1, 3), (1, 4), (1, 40)  # count, length, begin
BEFORE, AFTER = (0, 3), (1, 4)  # frames at rest before it begins, and after its success
NEAR = 0.03  # m, between the hand and where it is when things begin to move
BEGUN, GONE = 0.02, 0.15  # shares of their way that things have moved
TOUCH = 0.01  # m, of the gap between the robot and things: it is at them
MOST = 0.5  # of the longest way: what is struck in passing goes less far


class Stage(Protocol):
    """
    An environment with a script that solves it.

    :ivar task_name: what it is about.
    :ivar steps: of the environment from picture to picture.
    :ivar step_ns: nanoseconds of a step.
    :ivar reach: (2, 3) m, lowest and highest place that the hand is sent to.
    :ivar scale: (3,) m along x, y, z that a command of 1 asks for in a step.
    """

    task_name: str
    steps: int
    step_ns: int
    reach: np.ndarray
    scale: np.ndarray

    def begin(self, seed: int) -> None:
        """Begin the scene of a seed."""

    def act(self, command: np.ndarray) -> None:
        """Take a step with a command (A,) in [-1, 1]: three of motion, the last closes."""

    def command(self) -> np.ndarray:
        """Return what the script commands now."""

    def hand(self) -> np.ndarray:
        """Return where the hand is, (3,) m."""

    def movable(self) -> np.ndarray:
        """Return where all that can be moved is, (Q,) m and rad."""

    def gap(self) -> float:
        """Return how far the robot is from what can be moved, in m, FAR at most."""

    def picture(self) -> np.ndarray:
        """Return what the camera sees, (H, W, 3) uint8."""

    def succeeds(self) -> bool:
        """Return whether the environment is solved."""


@dataclass(frozen=True)
class Demonstration:
    """
    What is recorded of an expert.

    :param episode: of a script, whose actions are what was commanded, without objects and gripper.
    :param bottleneck: its first and last frame, by the simulator; None: not known.
    :param unknown: why it is not; '' where nobody looked.
    """

    episode: Episode
    bottleneck: tuple[int, int] | None = None
    unknown: str = ''


def demonstrate(stage: Stage, seed: int, num_frames: int = 0) -> Demonstration:
    """
    Let the script of a stage act; what does not succeed is drawn anew, TRIES times at most.

    :param num_frames: at most; 0: MOST_FRAMES.
    """
    # With the readers of other formats, which the table does without.
    from tap_ros.recording.formats.pictures import make_episode
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, attempt])
        stage.begin(int(rng.integers(2 ** 31)))
        rows, done = _act_unsteadily(stage, rng, num_frames or MOST_FRAMES)
        if done and len(rows) >= LEAST_FRAMES:
            break
    frames, *others = zip(*rows)
    commands, hands, places, gaps = map(np.stack, others)
    commands[-1] = 0
    episode = make_episode(
        frames, np.arange(len(rows)) * stage.steps * stage.step_ns / 1e9,
        actions=commands.astype(np.float32), object_source='', task=stage.task_name, seed=seed,
        outcome='success' if done else 'failure')
    return Demonstration(episode, *find_bottleneck(hands, places, gaps))


def to_episode(seen: Sequence[Observation], actions: np.ndarray, goal: Observation, task: str,
               seed: int, outcome: str) -> Episode:
    """
    Put what was observed and done into an Episode; where objects are is ground truth.

    :param seen: T Observations; actions: (T, 4) float32; goal: Observation of the goal.
    :param outcome: 'success', 'failure' or 'interrupted'.
    """
    return Episode(
        frames=np.stack([one.image for one in seen]),
        stamps=np.array([one.stamp_ns for one in seen], np.int64),
        actions=actions, grippers=np.stack([one.gripper for one in seen]),
        object_names=seen[0].object_names,
        object_pixels=np.stack([one.object_pixels for one in seen]),
        object_poses=np.stack([one.object_poses for one in seen]),
        goal_frame=goal.image, goal_pixels=goal.object_pixels, goal_poses=goal.object_poses,
        object_source='ground_truth', task=task, seed=seed, outcome=outcome,
        robot_masks=np.stack([one.robot_mask for one in seen]), goal_mask=goal.robot_mask)


def find_bottleneck(hands: np.ndarray, places: np.ndarray,
                    gaps: np.ndarray) -> tuple[tuple[int, int] | None, str]:
    """
    Find the frames in which the hand is at what it is about to move.

    They are of the last time that the robot comes to things, from FAR to TOUCH, and moves them
    most of their way: what settles by itself, or is struck in passing, does not count. They begin
    where the hand has come, for good, NEAR to where it is when things begin to move, and end when
    things have gone the share GONE of their way.

    :param hands: (T, 3) m.
    :param places: (T, Q) m and rad, of all that can be moved.
    :param gaps: (T,) m, between the robot and what can be moved.
    :return: first and last of these frames, or None; and why it is not known.
    """
    # Things settle in the first frame.
    most = max(np.linalg.norm(places[k:] - places[k - 1], axis=1).max()
               for k in range(2, len(places)))
    if most <= 1e-6:
        return None, 'nothing moves'
    if not (gaps < TOUCH).any():
        return None, 'the robot touches nothing that moves'
    first, last, is_far = 0, 0, gaps[0] >= FAR
    for k in range(1, len(gaps)):
        way = np.linalg.norm(places - places[k - 1], axis=1)
        way[:k] = 0
        if is_far and gaps[k] < TOUCH and way.max() >= MOST * most:
            begun, gone = (int((way > share * way.max()).argmax()) for share in (BEGUN, GONE))
            away = np.flatnonzero(np.linalg.norm(hands[:begun] - hands[begun], axis=1) >= NEAR)
            first, last = (int(away[-1]) + 1 if len(away) else 0), min(gone, len(gaps) - 2)
        is_far = gaps[k] >= FAR or (is_far and gaps[k] >= TOUCH)
    if not first:
        return None, 'the hand is there from the start'
    return ((first, last), '') if first <= last else (None, 'the hand comes with the last frame')


def _act_unsteadily(stage: Stage, rng: np.random.Generator,
                    num_frames: int) -> tuple[list[tuple[np.ndarray, ...]], bool]:
    """Return picture, command, hand, places and gap of each frame; whether it succeeded."""
    steps = stage.steps

    def some(frames: tuple[int, int]) -> int:
        return int(rng.integers(steps * frames[0], steps * frames[1], endpoint=True))

    speed, noise = rng.uniform(*SPEED), rng.uniform(*NOISE)
    pauses = {some(PAUSE_RANGE): some(PAUSE_FRAMES)
              for _ in range(rng.integers(*PAUSES, endpoint=True))}
    pauses[0] = some(BEFORE)
    goes_on = some(AFTER)
    by = np.clip(stage.hand() + rng.uniform(DETOUR_LOW, DETOUR_HIGH), *stage.reach)
    detour = DETOUR_FRAMES * steps if rng.random() < DETOUR_SHARE else 0
    rows, resting, done = list[tuple[np.ndarray, ...]](), 0, False
    action = np.zeros_like(stage.command())
    action[-1] = -1
    for step in range(num_frames * steps):
        if step % steps == 0:
            commanded = np.zeros(4)  # dx, dy, dz in m till the next picture, opening
            rows.append((
                stage.picture(), commanded, stage.hand().copy(), stage.movable().copy(),
                np.array(stage.gap())))
        resting = pauses.get(step, resting)
        if resting:
            resting -= 1
            action[:-1] = 0
        elif detour:
            gap = by - stage.hand()
            action[:3], action[3:-1] = speed * np.clip(10 * gap, -1, 1), 0
            detour = detour - 1 if np.linalg.norm(gap) > REACHED else 0
        else:
            action = stage.command()
            unsteady = rng.normal(0, noise, 3) * np.linalg.norm(action[:3]).clip(max=1)
            action[:3] = speed * action[:3] + unsteady
        action = np.clip(action, -1, 1)
        stage.act(action)
        commanded[:3] += stage.scale * action[:3]
        commanded[3] = (1 - action[-1]) / 2
        done = done or stage.succeeds()
        goes_on -= done
        if not goes_on:
            break
    return rows, done and not goes_on
