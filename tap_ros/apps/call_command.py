# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros call`: asks a running predictor node, for people."""

from dataclasses import dataclass
from pathlib import Path
import time
from typing import Annotated, Literal

import numpy as np
from tap_ros.apps.predict_command import labelled, read_inputs
from tap_ros.base.errors import ConfigError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import File
from tap_ros.base.text import escaped
from tap_ros.ros.calls import NotYet
from tap_ros.ros.client import Client
from tap_ros.ros.requests import request_fields, subgoals_of
from tyro import conf

ASK_AGAIN_S = 0.5
_Pixels = conf.arg(metavar='U,V [U,V ...]', help_behavior_hint='(default: of the topics)')


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param start: picture file to predict from; without it the newest picture of the camera.
    :param goal: picture file of the goal; without it the newest one on goal/image.
    :param objects: where objects are in the start picture: column and row of each. Without a start
        picture those of its topic are used.
    :param goal_objects: where the same objects are in the goal picture, in the same order.
    :param mode: start and goal, or the start alone; 'auto': what the node has weights for.
    :param samples: how many to draw of weights with z.
    :param recursion: subgoals in a row.
    :param seed: of z; the same one draws the same samples.
    :param namespace: of the node.
    :param timeout: s to wait for the node, the first pictures and the answer.
    :param out: PNG file to write: subgoals, with maps of where objects are then, and the picture
        files that were given.
    """

    start: File = ''
    goal: File = ''
    objects: Annotated[tuple[str, ...], _Pixels] = ()
    goal_objects: Annotated[tuple[str, ...], _Pixels] = ()
    mode: Literal['auto', 'bidirectional', 'forward'] = 'auto'
    samples: int = 1
    recursion: int = 1
    seed: int = 0
    namespace: str = ''
    timeout: float = 20.0
    out: File = 'prediction.png'


def run(args: Options) -> None:
    """
    Ask, print what came back, and draw it.

    :raises TapError: for files and options that cannot be used, when no node answers in time, and
        with the reason when it refuses.
    """
    if Path(args.out).suffix.lower() != '.png':
        raise ConfigError(f'--out {escaped(args.out)}: expected a .png file')
    pictures, pixels = read_inputs(
        {'start': args.start, 'goal': args.goal},
        {'--objects': args.objects, '--goal-objects': args.goal_objects})
    deadline = time.monotonic() + args.timeout
    with Client(args.namespace, args.timeout) as client:
        fields = request_fields(
            **pictures, **{f'{name}_objects': places for name, places in pixels.items()})
        response = None
        while response is None:
            try:
                response = client.call(
                    'predict', max(1.0, deadline - time.monotonic()), **fields,
                    mode='' if args.mode == 'auto' else args.mode, num_samples=args.samples,
                    recursion_depth=args.recursion, seed=args.seed)
            except NotYet:
                if time.monotonic() > deadline:
                    raise
                time.sleep(ASK_AGAIN_S)
    print(f'{escaped(response.message, 500)}; {response.model_time_ms:.0f} ms')
    subgoals = subgoals_of(response)
    names = response.subgoals[0].object_names
    if names:
        height, width = subgoals[0].image.shape[:2]
        print(f'in pixels of the predicted picture, {width}x{height}:')
    for subgoal in subgoals:
        places = ', '.join(f'{escaped(name, 40)} at {u:.1f},{v:.1f}'
                           for name, (u, v) in zip(names, subgoal.expected_pixels))
        print(f'sample {subgoal.sample + 1}, level {subgoal.level}: {places or "no objects"}')
    pixels.setdefault('start', np.zeros((len(names), 2)))
    write_atomically(args.out, labelled(pictures, pixels, subgoals))
    print(f'written: {escaped(args.out)}')
