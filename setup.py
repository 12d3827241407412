# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0

from glob import glob
from runpy import run_path
import sys

from setuptools import find_packages, setup

NAME = 'tap_ros'
CONTRACT = run_path('tap_ros/base/contract.py')
REQUIRED = [  # for pip
    'jinja2>=3.1',
    'lz4>=4.3',
    'mcap>=1.1',
    'mujoco>=4',
    'numpy>=1.26',
    'opencv-python-headless>=4.6',
    'pillow>=10.2',
    'pyyaml>=6.0',
    'rosbags>=0.11.7',
    'safetensors>=0.4.3',
    'scipy>=1.11',
    'tensorboard>=2.16',
    'torch>=2.6',
    'tqdm>=4.66',
    'tyro>=0.9',
    'zstandard>=0.22',
]

setup(
    name=NAME,
    version=CONTRACT['VERSION'],
    description='Time-agnostic prediction of subgoal images, and visual MPC, for ROS 2',
    maintainer='The tap_ros authors',
    maintainer_email='tap_ros@users.noreply.github.com',
    license='Apache-2.0',
    python_requires='>=3.11',
    packages=find_packages(include=['tap_ros', 'tap_ros.*', 'sim_bridge', 'sim_bridge.*']),
    package_data={
        NAME: ['*.pyi', 'apps/demo/*.html', 'apps/explorer/page/*', 'apps/mark_page/*',
               'apps/shared_page/*', 'py.typed', 'ros/*.xml', 'weights/*.md', 'weights/*.png',
               'weights/*.safetensors'],
        'sim_bridge': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', glob('config/*.yaml')),
        (f'share/{NAME}/config/layouts', glob('config/layouts/*')),
        (f'share/{NAME}/launch', glob('launch/*.launch.py')),
    ],
    # colcon takes what package.xml names: of apt's packages some are no distributions.
    install_requires=REQUIRED if 'setuptools.build_meta' in sys.modules else ['setuptools'],
    extras_require={  # what only some commands need; `colcon test` runs pytest because of the last
        'video': ['av'],
        'tfrecord': ['google-crc32c', 'protobuf'],
        'arrays': ['h5py'],
        'explorer': ['websockets'],
        'lerobot': ['av', 'pyarrow>=14.0.1'],  # those before run code that is in a file
        'ray': ['ray'],
        'test': ['pytest'],
    },
    zip_safe=False,
    entry_points={
        'console_scripts': [f'{name} = tap_ros.ros.run:main' for name in CONTRACT['NODE_CLASSES']],
    },
)
