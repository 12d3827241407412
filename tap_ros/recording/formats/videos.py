# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of videos, by OpenCV; of AV1, as LeRobot records it, by PyAV."""

from collections.abc import Callable, Iterable, Iterator
import math
import os
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from tap_ros.base.contract import MAX_PICTURE_BYTES
from tap_ros.base.errors import RecordingError
from tap_ros.base.text import escaped
from tap_ros.recording.bags import what_else
from tap_ros.recording.trust import MOST_FRAMES, regular

_FORMATS = 'mov,matroska,avi,h264'  # as FFmpeg calls them: none that names other files
_OPTIONS = {'format_whitelist': _FORMATS, 'protocol_whitelist': 'file'}
Show = Callable[[], np.ndarray]  # returns the picture, uint8 (H, W, 3) rgb
Item = TypeVar('Item')


def video_frames(path: Path) -> Iterator[tuple[float, Show]]:
    """
    Decode a video.

    :param path: of the file.
    :return: iterator over (seconds from the first frame, what shows it until the next is asked
        for); frames that are not shown cost less.
    :raises RecordingError: when it is not there, its codec is unknown, or its pictures too large;
        it does not name the file.
    """
    path = regular(path).resolve()  # with no scheme before it, such as cache:
    if why := what_else(path):
        raise RecordingError(why)
    os.environ['OPENCV_FFMPEG_CAPTURE_OPTIONS'] = '|'.join(map(';'.join, _OPTIONS.items()))
    capture, last = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), -1.0
    code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, 'little', signed=True)
    _check_size(*(capture.get(side) for side in (
        cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)))
    is_av1 = code.lower() == b'av01'
    if is_av1 or not capture.grab():
        capture.release()
        yield from _by_pyav(path, 'is AV1, as LeRobot records it, which OpenCV does not decode'
                            if is_av1 else 'is no video, or OpenCV knows no decoder for it')
        return

    def show() -> np.ndarray:
        good, frame = capture.retrieve()
        if not good:
            raise RecordingError('it cannot be decoded; fetch the file again')
        return cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)

    period, good = 1 / (capture.get(cv2.CAP_PROP_FPS) or 25), True
    while good:
        at = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        last = at if at > last else last + period  # some containers have no times
        yield last, show
        good = capture.grab()


def _by_pyav(path: Path, why: str) -> Iterator[tuple[float, Show]]:
    try:
        import av  # its wheels hold FFmpeg with libraries under GPL
    except ImportError:
        raise RecordingError(f'{why}; type `pip install av` (PyAV), or make it anew: ffmpeg -i '
                             'OLD.mp4 -c:v libvpx-vp9 NEW.mp4') from None
    try:
        with av.open(str(path), options=_OPTIONS) as container:
            stream = next(iter(container.streams.video), None)
            if stream is None:
                raise RecordingError('it holds no pictures')
            _check_size(stream.width, stream.height)
            for picture in container.decode(stream):
                _check_size(picture.width, picture.height)  # they may change
                yield float(picture.time or 0), lambda: picture.to_ndarray(  # noqa: B023
                    format='rgb24')
    except (av.FFmpegError, EOFError) as error:
        raise RecordingError('is no video, or a damaged one: '
                             f'{escaped(getattr(error, "strerror", error), 80)}') from None


def _check_size(width: float, height: float) -> None:
    if width * height * 3 > MAX_PICTURE_BYTES:
        raise RecordingError(f'its {width:.0f}x{height:.0f} pixels are more than '
                             f'{MAX_PICTURE_BYTES} bytes of rgb; make it smaller')


def at_rate(items: Iterable[tuple[float, Item]], rate: float) -> Iterator[tuple[float, Item]]:
    """
    Yield the first (seconds, item) in each period of a rate.

    :param items: in order of time.
    :param rate: a second; 0: all of them.
    :raises RecordingError: for more than a demonstration has.
    """
    period = -1
    for number, (at, item) in enumerate(items):
        if number > MOST_FRAMES:
            raise RecordingError(f'it is longer than {MOST_FRAMES} pictures; cut it into '
                                 'demonstrations')
        now = math.floor(at * rate + 1e-6) if rate and math.isfinite(at) else period + 1
        if now > period:
            period = now
            yield at, item
