# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is learned from marks of the bottleneck (recording/marks.py), and how good it is."""

from collections.abc import Callable, Mapping, Sequence
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
from tap_ros.base.errors import ConfigError
from tap_ros.images.robot_mask import hidden_pixels, RobotMask
from tap_ros.recording.marks import Mark, Marks, read_marks
from tap_ros.training.preference import (
    describe,
    learn_preference,
    LEAST_FRAMES,
    leave_one_out,
    Preference,
    still,
)

if TYPE_CHECKING:
    from tap_ros.recording.cache import EpisodeStore
    from tap_ros.training.predictor_config import TrainingConfig


def features_of(store: 'EpisodeStore', i: int, robot_mask: RobotMask) -> np.ndarray:
    """Describe the frames of an episode, (T, SIZE), without the pixels that a robot mask hides."""
    episode = store[i]
    return describe(episode.frames, None if robot_mask == 'none' or episode.robot_masks is None
                    else hidden_pixels(episode.robot_masks, robot_mask))


def episode_preferences(
        store: 'EpisodeStore', config: 'TrainingConfig', training: np.ndarray,
) -> tuple[list[np.ndarray] | None, dict[str, Any]]:
    """
    Compute the preference w(t) that a training needs, by stillness or learned from marks.

    :param training: indices of the episodes to train on.
    :return: w of each episode, float32 (levels, T), 1 in those too short for targets; None if it
        follows from the time. And what the weights file tells of the marks.
    """
    about: dict[str, Any] = {}
    if config.selection == 'still':
        preferences: Sequence[Callable[[np.ndarray], np.ndarray]] = [still] * config.recursion
    elif config.marks:
        marks = read_marks(config.marks, store)
        learned, levels = learn_marks(
            store, marks, training, config.recursion, config.forward, config.robot_mask)
        print_marks_report(levels)
        about = {'marks': {'sha256': marks.digest, 'levels': levels, 'preferences': [
            preference.to_json() for preference in learned]}}
        preferences = learned
    else:
        return None, about
    found = [np.ones((len(preferences), T), np.float32) for T in store.lengths]
    for i, w in enumerate(found):
        if w.shape[1] >= LEAST_FRAMES:
            features = features_of(store, i, config.robot_mask)
            w[:] = [preference(features) for preference in preferences]
    return found, about


def learn_marks(store: 'EpisodeStore', marks: Marks, training: np.ndarray, levels: int,
                forward: bool, robot_mask: RobotMask,
                ) -> tuple[list[Preference], list[dict[str, Any]]]:
    """
    Learn the preference of each level of recursion from marks, and say how good it is.

    Predictions between start and goal begin with the last mark, those from the start alone with
    the first.

    :param training: indices of the episodes to train on; marks of others are left out.
    :return: of each level its preference, and how well a mark is found by what is learned from
        the others.
    :raises ConfigError: without marks there, or where an episode has not one for each level.
    """
    chosen = sorted(set(marks.episodes) & set(training.tolist()))
    if not chosen:
        raise ConfigError(f'marks: none of the {len(marks.episodes)} marked demonstrations is '
                          'trained on; mark some of those that are not held out')
    for i in chosen:
        if len(marks.episodes[i]) != levels:
            raise ConfigError(
                f'marks: demonstration {i} has {len(marks.episodes[i])}, and each needs {levels}, '
                'one for a level of recursion; mark as many, or give --recursion')
    features = [features_of(store, i, robot_mask) for i in chosen]
    preferences, about = [], []
    for level in range(levels):
        at = [marks.episodes[i][level if forward else levels - 1 - level] for i in chosen]
        frames = [(first + last) // 2 for first, last in at]
        preferences.append(learn_preference(features, frames))
        facts: dict[str, Any] = {'demonstrations': len(chosen)}
        if len(chosen) > 1:
            within = leave_one_out(features, frames)
            facts |= {'found': int(within.sum()), 'random': float(np.mean([
                chance((t, t), len(one)) for t, one in zip(frames, features)]))}
        about.append(facts)
    return preferences, about


def chance(mark: Mark, length: int, tolerance: int = 1) -> float:
    """Return in which share of the frames between start and goal a mark would be hit."""
    first, last = max(1, mark[0] - tolerance), min(length - 2, mark[1] + tolerance)
    return (last - first + 1) / (length - 2)


def print_marks_report(about: Sequence[Mapping[str, Any]]) -> None:
    """Print before a training what the marks are worth; on stderr."""
    from scipy.stats import binomtest  # takes a second to import
    for level, facts in enumerate(about, start=1):
        count = facts['demonstrations']
        name = 'marks' if len(about) == 1 else f'marks, level {level}'
        if 'found' not in facts:
            text = 'one demonstration, so nothing tells what it is worth; mark ten'
        else:
            found, random = facts['found'], facts['random']
            low, high = binomtest(found, count).proportion_ci(method='wilson')
            text = (f'{count} demonstrations. Learned from the others, a mark is found within one '
                    f'frame in {found / count:.0%} ({low:.0%} to {high:.0%}), by a random frame in'
                    f' {random:.0%}')
            if low <= random:
                text += ': they are not told from chance; mark more, or other moments'
        print(f'{name}: {text}', file=sys.stderr)
