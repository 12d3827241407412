# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A camera that stands in for yours: 640x480 JPEG at 30 Hz, two blocks pushed over a table.

It is drawn, not simulated, and knows nothing of this package: `record` writes a bag with rosbags
alone, `publish` shows the beginning of another episode live, best effort.
"""

import argparse
import io

import numpy as np
from PIL import Image, ImageDraw

TOPIC = '/camera/color/image_raw/compressed'
TYPE = 'sensor_msgs/msg/CompressedImage'
HERTZ = 30
PAUSE = 10.0  # s between episodes
WIDTH, HEIGHT = 640, 480


def episode(seed):
    """
    Draw one episode: the hand pushes one block to its place, then the other.

    :param seed: of what is where.
    :return: list of PIL pictures.
    """
    rng = np.random.default_rng(seed)
    while True:  # in the square in the middle, and apart from each other
        starts, goals = rng.uniform([160, 90], [480, 390], (2, 2, 2))
        places = np.concatenate([starts, goals])
        gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
        ways = np.linalg.norm(goals - starts, axis=1)
        if gaps[np.triu_indices(4, 1)].min() > 90 and ways.max() < 220:
            break
    colours = [tuple(int(c) for c in rng.integers(60, 256, 3)) for _ in range(2)]
    blocks, hand, frames = starts.copy(), rng.uniform([160, 60], [480, 90]), []
    for k in np.argsort(np.linalg.norm(starts - hand, axis=1)).tolist():
        along = (goals[k] - starts[k]) / ways[k]
        for target, pushing in ((starts[k] - 50 * along, False), (goals[k] - 50 * along, True)):
            begin = hand.copy()
            steps = max(int(np.linalg.norm(target - begin) / 7), 1)
            for step in range(1, steps + 1):
                hand = begin + (target - begin) * step / steps
                if pushing:
                    blocks[k] = hand + 50 * along
                frames.append(draw(blocks, colours, hand))
    return frames


def draw(blocks, colours, hand):
    """Return one picture: table, blocks, and the hand above them."""
    picture = Image.new('RGB', (WIDTH, HEIGHT), (150, 116, 82))
    pen = ImageDraw.Draw(picture)
    for y in range(0, HEIGHT, 24):
        pen.line((0, y, WIDTH, y), fill=(138, 104, 72), width=2)
    for (x, y), colour in zip(blocks, colours):
        pen.rectangle((x - 26, y - 22, x + 34, y + 34), fill=(100, 76, 52))  # its shadow
        pen.rectangle((x - 30, y - 30, x + 30, y + 30), fill=colour)
    x, y = hand
    pen.ellipse((x - 14, y - 14, x + 30, y + 30), fill=(90, 68, 46))
    pen.ellipse((x - 22, y - 22, x + 22, y + 22), fill=(60, 62, 66))
    return picture


def jpeg(picture):
    """Return the bytes of a JPEG file."""
    buffer = io.BytesIO()
    picture.save(buffer, 'JPEG', quality=85)
    return buffer.getvalue()


def record(folder, episodes):
    """Write a bag as a recorder without any knowledge of episodes would."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_typestore, Stores
    store, seconds, count = get_typestore(Stores.ROS2_JAZZY), 1.0, 0
    kinds = store.types
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        for seed in range(episodes):
            for picture in episode(seed):
                stamp = int(seconds * 1e9)
                message = kinds[TYPE](
                    header=kinds['std_msgs/msg/Header'](
                        stamp=kinds['builtin_interfaces/msg/Time'](
                            sec=stamp // 10**9, nanosec=stamp % 10**9),
                        frame_id='camera_color_optical_frame'),
                    format='rgb8; jpeg compressed bgr8',
                    data=np.frombuffer(jpeg(picture), np.uint8))
                writer.write(connection, stamp, store.serialize_cdr(message, TYPE))
                seconds, count = seconds + 1 / HERTZ, count + 1
            seconds += PAUSE
    print(f'{count} pictures of {WIDTH}x{HEIGHT} on {TOPIC} in {folder}')


def publish(seed, goal):
    """Write the picture of the goal to a file, and show the start until interrupted."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CompressedImage
    frames = episode(seed)
    frames[-1].save(goal)
    rclpy.init()
    node = rclpy.create_node('example_camera')
    publisher = node.create_publisher(CompressedImage, TOPIC, qos_profile_sensor_data)
    message = CompressedImage(format='rgb8; jpeg compressed bgr8', data=jpeg(frames[0]))
    message.header.frame_id = 'camera_color_optical_frame'

    def show():
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)

    node.create_timer(1 / HERTZ, show)
    print(f'publishing on {TOPIC}, goal picture: {goal}', flush=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        pass


def main():
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    commands = parser.add_subparsers(dest='command', required=True)
    words = commands.add_parser('record', help='write a bag')
    words.add_argument('folder')
    words.add_argument('--episodes', type=int, default=200)
    words = commands.add_parser('publish', help='be a live camera')
    words.add_argument('--seed', type=int, default=1000)
    words.add_argument('--goal', default='goal.png', help='file for the picture of the goal')
    options = parser.parse_args()
    if options.command == 'record':
        record(options.folder, options.episodes)
    else:
        publish(options.seed, options.goal)


if __name__ == '__main__':
    main()
