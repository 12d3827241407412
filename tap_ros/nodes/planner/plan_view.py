# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plans drawn over what the planner sees, for any viewer."""

import cv2
import numpy as np
from tap_ros.images.drawing import draw_crosses, enlarge
from tap_ros.planning.forward_model import ForwardModelConfig
from tap_ros.planning.table import project
from tap_ros.planning.visual_mpc import Plan
import torch

SCALE, LARGEST = 6, 640  # times that a picture is enlarged, unless it gets wider than so many px
SHIFT = 4  # bits of a pixel's fractions, for cv2
FARTHEST = 2**14  # px; what is farther away is not seen, but could be too far for cv2
EDGE = (20, 20, 20)  # rgb, around what has to stand out
CHOSEN, ELITES, GRIPPER = (255, 225, 40), (150, 225, 255), (255, 50, 50)


def draw_plan(image: np.ndarray, config: ForwardModelConfig, plan: Plan, gripper: np.ndarray,
              targets: np.ndarray, sharp: np.ndarray | None = None) -> np.ndarray:
    """
    Draw where a plan and those it was chosen from lead the fingertips, and where objects shall be.

    :param image: uint8 (H, W, 3) rgb, as the planner sees it.
    :param config: of the forward model that sees these pictures.
    :param plan: visual_mpc.Plan.
    :param gripper: (4,) m, opening: where the plan begins.
    :param targets: (K, 2) (u, v), where the objects shall be.
    :param sharp: the picture before it was made smaller, which people see better; or None.
    :return: uint8 (H * scale, W * scale, 3), enlarged: the elites' ways thin, the chosen one bold,
        the gripper a dot, the targets crosses in OBJECT_COLOURS.
    """
    scale = max(min(SCALE, LARGEST // image.shape[1]), 1)
    canvas = enlarge(image, scale)
    if sharp is not None and len(sharp) > len(image):
        canvas = np.asarray(cv2.resize(sharp, canvas.shape[1::-1]))

    def seen(actions: np.ndarray) -> np.ndarray:
        """Return where actions lead, (N + 1, 2) in fractions of the canvas' pixels, for cv2."""
        pixels = fingertip_pixels(config, way(actions, gripper))
        at = np.nan_to_num((pixels + 0.5) * scale - 0.5, nan=-FARTHEST)
        return np.rint(at.clip(-FARTHEST, FARTHEST) * 2**SHIFT).astype(np.int32)

    thin = max(scale // 4, 1)
    for actions in plan.elites:
        cv2.polylines(canvas, [seen(actions)], False, ELITES, thin, cv2.LINE_AA, SHIFT)
    chosen = seen(plan.actions)
    for colour, width in ((EDGE, 5 * thin), (CHOSEN, 3 * thin)):
        cv2.polylines(canvas, [chosen], False, colour, width, cv2.LINE_AA, SHIFT)
    draw_crosses(canvas, targets, scale, EDGE)
    here = chosen[0].tolist()
    for colour, radius in ((EDGE, scale + thin), (GRIPPER, scale)):
        cv2.circle(canvas, here, radius << SHIFT, colour, cv2.FILLED, cv2.LINE_AA, SHIFT)
    return canvas


def fingertip_pixels(config: ForwardModelConfig, points: np.ndarray) -> np.ndarray:
    """
    Return where fingertips are in the picture, as far as the forward model knows.

    Its table says where in the picture they touch what lies there. Its arm is about the middle of
    hand and shadow, so that it only says how the picture changes with their height.

    :param points: (N, 3) m.
    :return: (N, 2) (u, v).
    """
    at = torch.from_numpy(points)
    low = at * torch.tensor([1.0, 1.0, 0.0])
    table = torch.tensor(config.table, dtype=at.dtype).view(3, 3)
    arm = torch.tensor(config.arm, dtype=at.dtype).view(3, 4)
    return (project(table, at[:, :2]) + project(arm, at) - project(arm, low)).numpy()


def way(actions: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """
    Return where actions lead the fingertips.

    :param actions: (N, 4) m per control period.
    :param gripper: (4,), where they begin.
    :return: (N + 1, 3) m.
    """
    return np.asarray(np.concatenate([gripper[None, :3], actions[:, :3]]).cumsum(0, dtype=float))
