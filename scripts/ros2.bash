#!/bin/bash
# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Build the ros2 command, launch and tf2_msgs into ros2/install, from the official sources; there are no wheels of them. scripts/environment.bash finds them there. The
# Makefile calls this.
#   ROS2_SOURCES=FOLDER takes the repositories from there: FOLDER/ros2cli and so on, git
#   repositories with the tags below, or plain copies of such sources. Else they are cloned.

set -eo pipefail
cd -P "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/step.bash
who=ros2
log=$PWD/ros2/build.log
repositories=(  # owner/name, tag, folders that are needed
  'ros2/ros2cli 0.32.2 ros2action ros2cli ros2component ros2doctor ros2interface ros2lifecycle
   ros2multicast ros2node ros2param ros2pkg ros2run ros2service ros2topic'
  'ros2/launch 3.4.3 launch launch_xml launch_yaml'
  'ros2/launch_ros 0.26.6 launch_ros ros2launch'
  'ros2/rosidl_runtime_py 0.13.1 .'
  'ros2/rcl_interfaces 2.0.2 composition_interfaces'
  'ros2/geometry2 0.36.4 tf2_msgs')

# Put the folders of one repository into ros2/src.
get() {
  local repository=$1 name=${1#*/} tag=$2 from target folder
  shift 2
  from=${ROS2_SOURCES:+$ROS2_SOURCES/$name} target=ros2/src/$name
  mkdir -p "$target"
  if [ -z "$from" ]; then
    git clone --quiet --depth 1 --branch "$tag" "https://github.com/$repository" "$target.git" ||
      return
    from=$target.git
  fi
  if git -C "$from" rev-parse --quiet --verify "$tag^{commit}" >/dev/null; then
    git -C "$from" archive "$tag" "$@" | tar x -C "$target" || return
  else
    for folder in "$@"; do cp -r "$from/$folder" "$target/" || return; done
  fi
  rm -rf "$target.git"
}

get_all() {
  local repository
  for repository in "${repositories[@]}"; do
    # shellcheck disable=SC2086  # words
    get $repository || return  # set -e does not hold within step
  done
}

build() {
  # Tests of theirs are not built; the log of colcon is of no use to anybody.
  COLCON_DEFAULTS_FILE=/dev/null colcon --log-base /dev/null build --merge-install \
    --base-paths ros2/src --build-base ros2/build --install-base ros2/install \
    --cmake-args -DBUILD_TESTING=OFF -DPython3_EXECUTABLE="$(command -v python)"
}

# What is there stays when there is nothing to replace it with.
for entry in "${repositories[@]}"; do
  read -r name _ <<<"${entry#*/}"
  if [ -n "$ROS2_SOURCES" ] && [ ! -e "$ROS2_SOURCES/$name" ]; then
    echo "$ROS2_SOURCES/$name is not there; ROS2_SOURCES must hold the repository ${entry%% *}"
    exit 1
  fi
done
rm -rf ros2
mkdir -p ros2/src
. scripts/environment.bash
step 'Python packages' pip install --disable-pip-version-check --requirement requirements-ros2.txt \
  --constraint constraints.txt $PIP_ARGS
step 'sources' get_all
step 'ros2 command, launch, tf2_msgs' build
rm -rf ros2/build ros2/src
. scripts/environment.bash
ros2 --help >/dev/null
echo '[ros2] done; type: . scripts/environment.bash'
