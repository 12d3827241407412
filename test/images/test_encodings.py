# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Every encoding shows the colours of the scene; what cannot be read is refused, and why."""

import io
from types import SimpleNamespace

import cv2
import numpy as np
from PIL import Image as Picture
import pytest
from tap_ros.base.errors import ImageError
from tap_ros.images.encodings import decompress, find_encoding, to_rgb
from tap_ros.messages.images import decode_image

SCENE = np.repeat(np.repeat(
    np.array([[[200, 30, 60], [10, 180, 90]]], np.uint8), 16, 0), 12, 1)  # left red, right green


def packed(picture, form):
    buffer = io.BytesIO()
    Picture.fromarray(picture).save(buffer, form)
    return buffer.getvalue()


def mosaic(pattern):
    raw = np.empty(SCENE.shape[:2], np.uint8)
    for k, letter in enumerate(pattern):
        raw[k // 2::2, k % 2::2] = SCENE[k // 2::2, k % 2::2, 'rgb'.index(letter)]
    return raw


def test_bytes_in_any_order_give_the_same_picture():
    picture = np.random.default_rng(1).integers(0, 256, (4, 6, 3), np.uint8)
    for name, order in (('rgb8', [0, 1, 2]), ('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 0]),
                        ('bgra8', [2, 1, 0, 0]), ('8UC3', [2, 1, 0]), ('8UC4', [2, 1, 0, 0])):
        assert find_encoding(name).pixel_bytes == len(order)
        np.testing.assert_array_equal(to_rgb(picture[..., order], name), picture)
    for name in ('mono8', '8UC1'):
        np.testing.assert_array_equal(
            to_rgb(picture[..., :1], name), picture[..., :1].repeat(3, -1))


def test_mosaics_have_the_colours_of_the_scene_also_compressed():
    for pattern in ('rggb', 'bggr', 'gbrg', 'grbg'):
        raw = mosaic(pattern)
        for found in (to_rgb(raw[..., None], f'bayer_{pattern}8'), decompress(
                packed(raw, 'PNG'), f'bayer_{pattern}8; png compressed ')):
            np.testing.assert_array_equal(found[2:-2, 2:9], SCENE[2:-2, 2:9])
            np.testing.assert_array_equal(found[2:-2, 15:-2], SCENE[2:-2, 15:-2])


def test_yuv_has_the_colours_of_the_scene():
    colour = np.array([200, 60, 30])
    parts = {  # ITU-R BT.601
        'y': 16 + np.array([65.481, 128.553, 24.966]) @ colour / 255,
        'u': 128 + np.array([-37.797, -74.203, 112.0]) @ colour / 255,
        'v': 128 + np.array([112.0, -93.786, -18.214]) @ colour / 255}
    for name, order in (('yuv422', 'uyvy'), ('uyvy', 'uyvy'), ('yuv422_yuy2', 'yuyv'),
                        ('yuyv', 'yuyv')):
        pair = np.array([round(parts[letter]) for letter in order], np.uint8)
        found = to_rgb(np.tile(pair, (4, 3)).reshape(4, 6, 2), name)
        assert np.abs(found.astype(int) - colour).max() <= 3


def test_planes_have_the_colours_of_the_scene_however_rows_are_counted():
    picture = cv2.resize(np.array([[[200, 60, 30], [30, 160, 90]]], np.uint8), (16, 12))
    planes = cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420)
    grey, (u, v) = planes[:12], planes[12:].reshape(2, 6, 8)
    for name, colours in (('i420', [u, v]), ('nv12', np.stack([u, v], -1)),
                          ('nv21', np.stack([v, u], -1))):
        raw = np.concatenate([grey.ravel(), np.ravel(colours)]).reshape(-1, 16)
        for height in (12, len(raw)):
            found = decode_image(SimpleNamespace(
                header=SimpleNamespace(frame_id=''), height=height, width=16, step=20,
                encoding=name, data=np.pad(raw, ((0, 0), (0, 4))).tobytes()))
            assert np.abs(found.astype(int) - picture).mean() < 6, name


def test_encodings_and_sizes_that_there_are_not_are_refused():
    for name, words in (
            ('yuv444', 'valid encodings: rgb8, bgr8'), ('', "''"), ('x\n' + 99 * 'y', r'x\\nyyy'),
            ('16UC1', 'more than 8 bits a channel, as depth cameras'), ('32FC1', 'more than 8'),
            ('bayer_rggb16', 'more than 8 bits')):
        with pytest.raises(ImageError, match=words):
            find_encoding(name)
    for name, height, width in (('yuv422', 2, 3), ('bayer_rggb8', 5, 6), ('bayer_rggb8', 2, 2)):
        size = find_encoding(name).pixel_bytes
        with pytest.raises(ImageError, match=f'{width}x{height} pixels of encoding {name}'):
            to_rgb(np.zeros((height, width, size), np.uint8), name)


def smooth(seed, size=(120, 160)):
    """Return a picture as of a camera: colours that change slowly, and noise."""
    random = np.random.default_rng(seed)
    coarse = cv2.resize(random.integers(0, 256, (6, 8, 3), np.uint8), size[::-1])
    return np.clip(coarse + random.normal(0, 4, coarse.shape), 0, 255).astype(np.uint8)


def test_a_jpeg_that_holds_every_pixel_is_read_whatever_stands_around_them():
    for picture in (smooth(0), SCENE, smooth(1)[..., 0], np.zeros((8, 8, 3), np.uint8)):
        for options in ({}, {'progressive': True}, {'restart_marker_rows': 1}, {'quality': 20},
                        {'optimize': True, 'subsampling': 0}):
            buffer = io.BytesIO()
            Picture.fromarray(picture).save(buffer, 'JPEG', **options)
            data, expected = buffer.getvalue(), Picture.open(buffer).convert('RGB')
            body = data[:-2]  # without the mark of its end
            tables = data.index(b'\xff\xc4'), data.index(b'\xff\xda')
            others = [] if len(options) or picture.ndim == 2 else [
                data[:tables[0]] + data[tables[1]:]]  # Motion JPEG: the usual tables
            for changed in (data, body, body + b'\xff', body + bytes(99), data + b'behind',
                            body + bytes(3) + data[-2:], body + b'\xff\xff' + data[-2:],
                            body + b'\xff\xfe\0\5hey' + data[-2:],
                            body + b'padding.' + data[-2:], *others):
                np.testing.assert_array_equal(decompress(changed, 'jpeg'), expected)


def test_a_jpeg_that_lacks_pixels_or_holds_others_is_damaged():
    random = np.random.default_rng(0)
    for seed in range(8):
        data = packed(smooth(seed), 'JPEG')
        begin = data.index(b'\xff\xda') + 14
        at = int(random.integers(begin, len(data) - 700))
        for changed in (data[:at] + random.bytes(500) + data[at + 500:], data[:at],
                        data[:at] + random.bytes(300) + data[at:], data[:at] + data[at + 600:],
                        data[:at] + bytes(600) + data[at + 600:], data[:at] + data[-2:],
                        data[:at] + bytes(len(data) - at),
                        data[:begin - 14] + random.bytes(99) + data[begin - 14:]):
            with pytest.raises(ImageError, match='damaged|cannot be used'):
                decompress(changed, 'jpeg')


def test_other_files_are_read_and_png_without_its_end():
    for form, error in (('PNG', 0), ('WEBP', 9), ('AVIF', 9), ('JPEG2000', 9)):
        found = decompress(packed(smooth(2), form), form)
        assert np.abs(found.astype(int) - smooth(2)).mean() <= error
    data = packed(smooth(2), 'PNG')
    np.testing.assert_array_equal(decompress(data[:-12], 'png'), smooth(2))


def test_compressed_pictures_that_cannot_be_used_are_refused_with_the_reason():
    deep = np.full((8, 8), 40000, np.uint16)
    _, colour = cv2.imencode('.png', np.full((8, 8, 3), 40000, np.uint16))
    for data, form, words in (
            (packed(SCENE, 'JPEG')[:400], 'jpeg', 'damaged compressed picture'),
            (b'no picture', 'jpeg', "no picture, or a damaged one: 'jpeg'; valid are JPEG"),
            (packed(deep, 'PNG'), '16UC1; png compressed', 'more than 8 bits a channel'),
            (colour.tobytes(), 'rgb16; png compressed', 'more than 8 bits a channel'),
            (packed(deep, 'PNG'), '16UC1; compressedDepth png', 'record the colour camera'),
            (packed(np.zeros((4000, 4000, 3), np.uint8), 'PNG'), 'png', '4000x4000 pixels are')):
        with pytest.raises(ImageError, match=words):
            decompress(data, form)
