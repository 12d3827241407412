# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""For rosdoc2, which adds its own settings; see rosdoc2.yaml."""

extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.viewcode']
myst_heading_anchors = 3
