# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros call`: asks a running predictor node, for people."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidNamespaceException
from rclpy.signals import SignalHandlerOptions
from tap_msgs.msg import ObjectStates
from tap_msgs.srv import PredictSubgoal
from tap_ros.contract import CAMERA_FRAME
from tap_ros.errors import ConfigError
from tap_ros.files import write_atomically
from tap_ros.nodes.clients import call, CallError, Spinner
from tap_ros.nodes.heartbeat import Liveness
from tap_ros.nodes.image_messages import encode_image
from tap_ros.nodes.middleware import configure_fast_dds
from tap_ros.nodes.object_messages import encode_objects
from tap_ros.nodes.subgoal_messages import decode_subgoals
from tap_ros.nodes.topics import SERVICE_QOS, to_stamp
from tap_ros.options import File
from tap_ros.prediction.predict_command import labelled, read_picture, read_pixels
from tap_ros.text import escaped
from tyro import conf

_Pixels = conf.arg(metavar='U,V [U,V ...]', help_behavior_hint='(default: of the topics)')
_NOWHERE = (0, 0, 0, 0, 0, 0, 1)  # a pose that says nothing


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param start: picture file to predict from; without it the newest picture of the camera.
    :param goal: likewise; without it the newest one on goal/image.
    :param objects: where objects are in the start picture: column and row of each. Without a start
        picture those of its topic are used.
    :param goal_objects: where the same objects are in the goal picture, in the same order.
    :param mode: start and goal, or the start alone; 'auto': what the node has weights for.
    :param samples: how many to draw of weights with z.
    :param recursion: subgoals in a row.
    :param seed: of z; the same one draws the same samples.
    :param namespace: of the node.
    :param timeout: s to wait for the node and its answer.
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
    out: File = 'subgoal.png'


def run(args: Options) -> None:
    """
    Ask, print what came back, and draw it.

    :raises TapError: for files and options that cannot be used, when no node answers in time, and
        with the reason when it refuses.
    """
    if Path(args.out).suffix.lower() != '.png':
        raise ConfigError(f'--out {escaped(args.out)}: expected a .png file')
    request = make_request(args)
    configure_fast_dds()
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            node = rclpy.create_node('tap_ros_call', namespace=args.namespace, context=context)
        except InvalidNamespaceException as error:
            raise ConfigError(f'--namespace {escaped(args.namespace, 60)}: is no name of a '
                              'namespace, such as /left') from error
        with Spinner(node):
            client = node.create_client(PredictSubgoal, 'predict_subgoal', qos_profile=SERVICE_QOS)
            name = client.service_name
            response = call(client, request, args.timeout,
                            server=Liveness(node, 'predictor_node'))
        node.destroy_node()
    finally:
        context.try_shutdown()
    if not response.success:
        raise CallError(f'{name} refused: {response.message}')
    print(f'{escaped(response.message, 500)}; {response.model_time_ms:.0f} ms')
    first = response.subgoals[0] if response.subgoals else None
    names = tuple(first.object_names) if first else ()
    size = (first.image.height, first.image.width) if first else (0, 0)
    subgoals = decode_subgoals(response, names, size)
    if names:
        print(f'in pixels of the predicted picture, {size[1]}x{size[0]}:')
    for subgoal in subgoals:
        places = ', '.join(f'{escaped(name, 40)} at {u:.1f},{v:.1f}'
                           for name, (u, v) in zip(names, subgoal.expected_pixels))
        print(f'sample {subgoal.sample + 1}, level {subgoal.level}: {places or "no objects"}')
    pictures = {name: read_picture(file) for name, file in (
        ('start', args.start), ('goal', args.goal)) if file}
    pixels = {'start': read_pixels(args.objects, '--objects') if args.objects else np.zeros(
        (len(names), 2)), 'goal': read_pixels(args.goal_objects, '--goal-objects')}
    write_atomically(args.out, labelled(pictures, pixels, subgoals))
    print(f'written: {escaped(args.out)}')


def make_request(args: Options) -> PredictSubgoal.Request:
    """
    Turn options into a request.

    :raises ConfigError: for positions that cannot be used; ImageError: for a picture file.
    """
    if not -2**63 <= args.seed < 2**63:
        raise ConfigError(f'--seed {args.seed}: expected a number of 64 bits')
    request = PredictSubgoal.Request(
        mode='' if args.mode == 'auto' else args.mode,
        num_samples=_count(args.samples, '--samples'),
        recursion_depth=_count(args.recursion, '--recursion'), seed=args.seed)
    for name, file, positions, option in (
            ('start', args.start, args.objects, '--objects'),
            ('goal', args.goal, args.goal_objects, '--goal-objects')):
        if positions and not file:
            raise ConfigError(f'{option}: name the picture that they are in, --{name} FILE')
        if file:
            stamp = to_stamp(0)
            setattr(request, name, encode_image(read_picture(file), stamp, CAMERA_FRAME))
            setattr(request, f'{name}_objects', _objects(positions, option))
    return request


def _objects(positions: Sequence[str], option: str) -> ObjectStates:
    """Return a message of objects that are called by their place in the list."""
    pixels = read_pixels(positions, option)
    return encode_objects([f'object {k + 1}' for k in range(len(pixels))], pixels,
                          np.array([_NOWHERE] * len(pixels)), to_stamp(0), CAMERA_FRAME,
                          ObjectStates.SOURCE_TRACKED)


def _count(value: int, option: str) -> int:
    """Refuse what a message cannot hold."""
    if not 1 <= value < 2**31:
        raise ConfigError(f'{option} {value}: expected 1 or more')
    return value
