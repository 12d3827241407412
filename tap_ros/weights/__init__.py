# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the shipped weights are."""

from pathlib import Path

FORWARD_MODEL = Path(__file__).with_name('forward_model_push.safetensors')
PREDICTOR = Path(__file__).with_name('predictor_push.safetensors')
