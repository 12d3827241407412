# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The site that `make docs` builds from the pages as they are in the repository."""

import tap_ros

project = 'tap_ros'
author = copyright = 'The tap_ros authors'
version = release = tap_ros.__version__
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.viewcode']

# autodoc leaves out in silence what cannot be imported.
assert all(hasattr(tap_ros, name) for name in tap_ros.__all__)

# The repository is the source, so that links between pages are right there and here.
root_doc = 'README'
include_patterns = ['*.md', 'CHANGELOG.rst', 'bags/README.md', 'docs/*.md', 'docs/results/*.md',
                    'docs/site/*.md', 'tap_ros/weights/*.md']
exclude_patterns = ['.*', 'venv', 'build', 'install', 'log', 'ros2', 'runs', 'test']
myst_heading_anchors = 3
html_theme = 'furo'
html_title = 'tap_ros'
html_extra_path = ['index.html']

autodoc_default_options = {
    'members': True, 'imported-members': True,
    'exclude-members': 'clip'}  # a field of Problem with numpy's docstring
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings say types, shapes and units

CONTENTS = {
    'Learn and do': ('docs/first_hour', 'docs/training', 'docs/ros', 'docs/real_arm',
                     'docs/extending'),
    'Look up': ('docs/python', 'docs/site/api', 'docs/interface', 'bags/README', 'docs/speed'),
    'Understand': ('docs/architecture', 'docs/paper_map', 'docs/results/README', 'docs/results/*',
                   'docs/peers'),
    'Project': ('CONTRIBUTING', 'SECURITY', 'QUALITY_DECLARATION', 'CHANGELOG'),
    'Weights': ('tap_ros/weights/*',)}


def add_contents(app, name, source):
    """Add to the README what the sidebar lists, which a repository's page cannot say."""
    if name == root_doc:
        source[0] += ''.join(
            f'\n```{{toctree}}\n:hidden:\n:glob:\n:maxdepth: 1\n:caption: {caption}\n\n'
            + '\n'.join(f'/{page}' for page in pages) + '\n```\n'
            for caption, pages in CONTENTS.items())


def setup(app):
    """Let sphinx call what is above."""
    app.connect('source-read', add_contents)
