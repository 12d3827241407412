# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Both packages, built with ROS 2 Jazzy from apt as in docs/ros.md:
#   docker build -t tap_ros .
#   docker run --rm -it tap_ros python3 -m tap_ros demo
# With torch for NVIDIA GPUs, some gigabytes more: docker build --build-arg PIP_ARGS= ...
FROM ros:jazzy-ros-base

SHELL ["/bin/bash", "-o", "pipefail", "-c"]

COPY package.xml /tmp/tap_ros/
COPY tap_msgs/package.xml /tmp/tap_ros/tap_msgs/
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri python3-venv \
    && rosdep install --from-paths /tmp/tap_ros /tmp/tap_ros/tap_msgs --ignore-src -y \
    && rm -rf /tmp/tap_ros /var/lib/apt/lists/*

# Images of Ubuntu 24.04 have this user.
# hadolint ignore=DL3066
USER ubuntu
RUN mkdir -p ~/ws/src/tap_ros
WORKDIR /home/ubuntu/ws

ARG PIP_ARGS='--extra-index-url https://download.pytorch.org/whl/cpu'
ENV VIRTUAL_ENV=/home/ubuntu/ws/.venv
ENV PATH=$VIRTUAL_ENV/bin:$PATH MUJOCO_GL=egl
COPY --chown=ubuntu:ubuntu requirements.txt src/tap_ros/
# hadolint ignore=SC2086
RUN python3 -m venv --system-site-packages .venv \
    && touch .venv/COLCON_IGNORE \
    && pip install --no-cache-dir $PIP_ARGS -r src/tap_ros/requirements.txt

COPY --chown=ubuntu:ubuntu . src/tap_ros/
RUN . /opt/ros/jazzy/setup.bash \
    && colcon build --base-paths src/tap_ros src/tap_ros/tap_msgs \
    && rm -rf log \
    && echo '. ~/ws/install/setup.bash && . ~/ws/.venv/bin/activate' >>~/.bashrc

ENTRYPOINT ["/bin/bash", "-c", ". /home/ubuntu/ws/install/setup.bash && exec \"$@\"", "--"]
CMD ["bash"]
