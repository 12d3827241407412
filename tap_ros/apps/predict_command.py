# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The command `python -m tap_ros predict`: subgoals from picture files, as a labelled picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
import sys
from typing import Annotated, TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tap_ros.base.contract import object_names
from tap_ros.base.errors import ConfigError, ImageError, RecordingError
from tap_ros.base.files import write_atomically
from tap_ros.base.options import File
from tap_ros.base.text import escaped
from tap_ros.images.crop import Crop, WHOLE
from tap_ros.images.drawing import grid, OBJECT_COLOURS, overlay, png_bytes
from tap_ros.images.encodings import decompress
from tap_ros.images.pixels import in_picture, resize_image, resize_pixels
from tap_ros.recording.reading import Part
from tap_ros.recording.trust import read_bytes
from tap_ros.weights import DEFAULT_PREDICTOR, PREDICTORS
from tyro import conf

if TYPE_CHECKING:
    from tap_ros.messages.subgoals import Subgoal
    from tap_ros.prediction.protocol import Predictor

PANEL, HEAD = 260, 26  # px, least side of a picture, and above it for its title
LARGEST_PANEL = 480  # px; larger pictures are made smaller for the sheet
_LARGEST = 2 ** 29  # bytes of rgb, of a picture file; phones make larger ones than cameras stream
FAINT = 0.5  # share of an object that is in the prediction, below which it is hardly there

_Pixels = conf.arg(metavar='U,V [U,V ...]', help_behavior_hint='(default: none)')


@dataclass(frozen=True)
class Options:
    """
    Options of the command.

    :param start: picture file: JPEG, PNG or WebP.
    :param goal: picture file of the goal; left out for weights that predict from the start alone.
    :param objects: where the objects are in the start picture: column and row of each, in the
        pixels of the file.
    :param goal_objects: where the same objects are in the goal picture, in the same order.
    :param crop: the part of the pictures that is used: 'centre', the largest square in the middle;
        LEFT,TOP,SIDE, a square in pixels of the file; 'whole', all of it, squeezed into the shape
        that the weights take; by default as the weights were trained.
    :param samples: how many to draw of weights with z.
    :param recursion: subgoals in a row.
    :param seed: of z; the same one draws the same samples.
    :param out: PNG file to write: start, goal and subgoals, with maps of where objects are then.
    """

    start: Annotated[conf.Positional[str], conf.arg(metavar='START')]
    goal: Annotated[conf.Positional[str], conf.arg(
        metavar='GOAL', help_behavior_hint='(default: none)')] = ''
    weights: Annotated[str, conf.arg(
        metavar='FILE', help='a file; shipped ones: ' + ', '.join(PREDICTORS)
        + '; or another predictor, such as nearest_keyframe:bags/push2.'
    )] = DEFAULT_PREDICTOR
    objects: Annotated[tuple[str, ...], _Pixels] = ()
    goal_objects: Annotated[tuple[str, ...], _Pixels] = ()
    crop: Part = ''
    samples: int = 1
    recursion: int = 1
    seed: int = 0
    out: File = 'prediction.png'


def run(args: Options) -> None:
    """
    Predict, print where the objects should then be, and write the picture.

    :raises TapError: for a file, pixels or weights that cannot be used, saying why.
    """
    from tap_ros.prediction.protocol import load_predictor
    if Path(args.out).suffix.lower() != '.png':
        raise ConfigError(f'--out {escaped(args.out)}: expected a .png file')
    if Path(args.out).resolve() in (Path(args.start).resolve(), Path(args.goal).resolve()):
        raise ConfigError(f'--out {escaped(args.out)}: is a picture to predict from; give another')
    predictor = load_predictor(args.weights)
    pictures, pixels = read_inputs(
        {'start': args.start or '.', 'goal': args.goal},  # an empty name is refused as a folder
        {'--objects': args.objects, '--goal-objects': args.goal_objects})
    if args.goal and len(pixels['start']) != len(pixels['goal']):
        raise ConfigError(
            f'--objects and --goal-objects: {len(pixels["start"])} and {len(pixels["goal"])} '
            'positions; give those of the same objects in both pictures')
    parts, places, windows = {}, {}, {}
    for name, picture in pictures.items():
        cut = Crop(args.crop) if args.crop else predictor.camera_crop.of(picture.shape[:2], name)
        if not args.crop and (why := predictor.camera_crop.unlike(picture.shape[:2], name)):
            print(f'warning: {why}', file=sys.stderr)
        windows[name] = Crop(cut.part).window(picture.shape[:2])
        parts[name], places[name] = fit(
            picture, windows[name], pixels[name], predictor, name, cut.part == WHOLE)
    subgoals = predictor.predict(
        parts['start'], parts.get('goal'), places['start'], places.get('goal'),
        num_samples=args.samples, recursion_depth=args.recursion, seed=args.seed)
    for warning in {subgoal.warning: None for subgoal in subgoals if subgoal.warning}:
        print(f'warning: {warning}', file=sys.stderr)
    (left, top, *extent), names = windows['start'], object_names(len(places['start']))
    for subgoal in subgoals:
        print(f'{_title(subgoal, len(subgoals))}{":" if len(places["start"]) else ""}')
        for name, where, mass, undecided in zip(
                names, subgoal.expected_pixels, subgoal.mass, subgoal.undecided):
            u, v = (where + 0.5) * extent / subgoal.image.shape[1::-1] - 0.5 + (left, top)
            notes = ['the mean of several likely places'] * bool(undecided)
            if mass < FAINT:
                notes.append(f'only {mass:.0%} of the object is in the prediction')
            print(f'  {name} at {u:.1f},{v:.1f}' + f' ({"; ".join(notes)})' * bool(notes))
    if any(subgoal.undecided.any() for subgoal in subgoals):
        print('note: these weights do not decide between several places; they may not know scenes '
              'like these pictures')
    write_atomically(args.out, labelled(parts, places, subgoals))
    print(f'written: {escaped(args.out)}')
    if not names:
        scenes = ' and whether the weights know such scenes' * math.isnan(subgoals[0].distance)
        print('note: without --objects it is not checked whether all objects are in the '
              f'prediction{scenes}; look at the picture')


def read_inputs(files: Mapping[str, str], positions: Mapping[str, Sequence[str]],
                ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """
    Read picture files, just as a compressed picture of a camera is read, and positions in them.

    :param files: of 'start' and 'goal', JPEG, PNG or WebP; '' where there is none.
    :param positions: by their options the positions in these, see read_pixels.
    :return: of those that are there uint8 (H, W, 3) rgb, and float32 (K, 2), (u, v).
    :raises ImageError: for a file that is no picture, is damaged, or has no end.
    :raises ConfigError: for positions that are none, or without a picture.
    """
    pictures, pixels = {}, {}
    for (name, file), (option, words) in zip(files.items(), positions.items(), strict=True):
        if words and not file:
            raise ConfigError(f'{option}: name the {name} picture that they are in, too')
        if file:
            pixels[name] = read_pixels(words, option)
            try:
                pictures[name] = decompress(
                    read_bytes(file, _LARGEST), Path(file).suffix[1:], _LARGEST)
            except ImageError as error:
                raise ImageError(f'{escaped(file)}: {error}') from error
            except RecordingError as error:
                raise ImageError(str(error)) from error
    return pictures, pixels


def read_pixels(words: Sequence[str], option: str) -> np.ndarray:
    """
    Read positions.

    :param words: list of 'u,v'.
    :param option: that they were given with.
    :return: float32 (K, 2), (u, v).
    :raises ConfigError: for a word that is none.
    """
    pixels = []
    for word in words:
        try:
            u, v = (float(number) for number in word.split(','))
        except ValueError:
            raise ConfigError(f'{option} {escaped(word)}: expected column,row of an object, such '
                              'as 20,30') from None
        pixels.append((u, v))
    return np.array(pixels, np.float32).reshape(-1, 2)


def fit(picture: np.ndarray, window: Sequence[int], pixels: np.ndarray, predictor: 'Predictor',
        name: str, squeezed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """
    Cut a picture, and positions in it, to what the weights take; scale them where they need it.

    :param picture: uint8 (H, W, 3).
    :param window: left, top, width and height of the part.
    :param pixels: (K, 2), (u, v) in the picture.
    :param name: how errors call it.
    :param squeezed: take a part of any shape.
    :return: uint8 (height, width, 3) and float32 (K, 2).
    :raises ImageError: for another shape, or a position outside.
    """
    (left, top, W, H), size = window, predictor.image_size
    full = predictor.camera_crop.is_cut((H, W))
    if not full and not squeezed and W * size[0] != H * size[1]:
        how = ('say which part of it is used, by --crop centre or --crop LEFT,TOP,SIDE, or '
               if size[0] == size[1] else 'give pictures of that shape, or ')
        raise ImageError(f'{name}: {W}x{H} pixels (width x height); the weights take pictures of '
                         f'the shape {size[1]}x{size[0]}; {how}squeeze all of it, by --crop whole')
    inside = pixels - np.array([left, top], np.float32)
    if not in_picture(inside, (H, W)).all():
        raise ImageError(
            f'{name}: an object is outside the part that the weights see, {W}x{H} pixels from '
            f'column {left}, row {top} on; expected column,row in the picture as it is in the '
            'file; leave others out in both pictures')
    part = np.ascontiguousarray(picture[top:top + H, left:left + W])
    if full and getattr(predictor, 'full_size', False):
        return part, inside
    return resize_image(part, size), resize_pixels(inside, (H, W), size)


def labelled(pictures: dict[str, np.ndarray], pixels: dict[str, np.ndarray],
             subgoals: Sequence['Subgoal']) -> bytes:
    """
    Draw a picture for people.

    :param pictures: 'start' and perhaps 'goal', uint8 (H, W, 3).
    :param pixels: of the objects in these, (K, 2) each.
    :param subgoals: list of Subgoal; a row for each, its maps beside it where there are objects.
    :return: bytes of a PNG file.
    """
    rows = []
    side = max(PANEL, min(LARGEST_PANEL, *(max(one.image.shape) for one in subgoals)))
    for subgoal in subgoals:
        height, width = subgoal.image.shape[:2]
        panels = [(
            name if picture.shape[0] * width == picture.shape[1] * height else f'{name}, whole',
            picture, pixels[name]) for name, picture in pictures.items()]
        panels.append((_title(subgoal, len(subgoals)), subgoal.image, pixels['start'][:0]))
        if len(pixels['start']):
            panels.append(('where the objects are then', overlay(
                subgoal.image, subgoal.object_maps), subgoal.expected_pixels))
        rows.append([_panel(*panel, side) for panel in panels])
    return png_bytes(grid(rows))


def _panel(title: str, picture: np.ndarray, marks: np.ndarray, side: int) -> np.ndarray:
    """Draw a picture below its title, as wide as `side`, and a number beside each pixel (K, 2)."""
    height, width = picture.shape[:2]
    scale = side / max(height, width)
    image = Image.new('RGB', (side, HEAD + side), 'white')
    image.paste(Image.fromarray(picture).resize(
        (round(scale * width), round(scale * height)),
        Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX), (0, HEAD))
    draw = ImageDraw.Draw(image)
    draw.text((2, HEAD // 2), title, 'black', ImageFont.load_default(16), anchor='lm')
    for k, (u, v) in enumerate((np.asarray(marks) + 0.5) * scale):
        if np.isfinite((u, v)).all():
            u, v = u + 12, v + HEAD - 12
            colour = OBJECT_COLOURS[k % len(OBJECT_COLOURS)]
            draw.line((u - 12, v + 12, u, v), colour, 2)
            draw.ellipse((u - 9, v - 9, u + 9, v + 9), colour, 'white')
            draw.text((u, v), str(k), 'white', ImageFont.load_default(14), anchor='mm')
    return np.array(image)


def _title(subgoal: 'Subgoal', count: int) -> str:
    """Say which subgoal it is."""
    return 'subgoal' if count == 1 else f'sample {subgoal.sample + 1}, level {subgoal.level}'
