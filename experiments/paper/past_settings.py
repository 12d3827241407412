# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of trainings as results of earlier versions tell them."""

from dataclasses import asdict

from experiments.paper.methods import method_fields
from tap_ros.training.predictor_config import TrainingConfig

# Settings of earlier versions, and the value that they have now, or at which they did nothing.
_GONE = {'bell_edge': 2 / 3, 'changed_weight': 0.0, 'match_temperature': 0.0, 'match_share': 0.5,
         'flow_scale': 16.0, 'max_frames': 0, 'pretrain_steps': 0, 'outer_power': 1.0,
         'compile': False, 'discriminator_rate': 2e-4, 'gan_weight': 5e-5, 'flip': True,
         'latent_size': 32, 'video_frames': 16, 'warmup': 100, 'gradient_clip': 1.0,
         'average_decay': 0.999}


def todays_settings(settings):
    """Return settings of any version by today's fields; what is gone keeps its name."""
    gone = {**_GONE, 'image_topic': '', 'detach_recursion': settings.get('recursion', 1) > 1}
    kept = {name: value for name, value in settings.items()
            if name != 'method' and (name not in gone or value != gone[name])}
    named = method_fields(settings['method']) if 'method' in settings else {}
    return asdict(TrainingConfig(recordings=(), split='crc32')) | kept | named
