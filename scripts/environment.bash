# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Source this in bash to work in the environment that `make build` made:
#   . scripts/environment.bash
# It uses the ROS 2 of that environment, and puts another one that the shell had sourced aside.

# The files of colcon and of virtual environments ask for variables that there are not.
case $- in *u*) tap_nounset=1; set +u ;; *) tap_nounset= ;; esac

tap_root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

if [ -n "${AMENT_PREFIX_PATH:-}" ]; then
  unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH
  unset ROS_DISTRO ROS_PYTHON_VERSION ROS_VERSION
fi
# The wheels set LD_LIBRARY_PATH for themselves, once, and note that here.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE

. "$tap_root/.venv/bin/activate"
export AMENT_PREFIX_PATH=$VIRTUAL_ENV CMAKE_PREFIX_PATH=$VIRTUAL_ENV
export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
export MUJOCO_GL=${MUJOCO_GL:-egl}

if [ -f "$tap_root/ros2/install/local_setup.bash" ]; then  # of `make ros2`
  . "$tap_root/ros2/install/local_setup.bash"
fi
if [ -f "$tap_root/install/setup.bash" ]; then
  . "$tap_root/install/setup.bash"
fi
unset -f ros2
command -v ros2 >/dev/null || ros2() {
  echo 'The ros2 command is not built. Type once: make ros2; then: . scripts/environment.bash' >&2
  return 127
}
[ -z "$tap_nounset" ] || set -u
unset tap_root tap_nounset
