# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Sourced by the scripts of the set-up, which say by `who` who they are and by `log` in which file
# they keep what their steps print.

minute=60  # s

# step 'what' command...: run quietly into the log, print one line with the time it took. Meanwhile
# a terminal counts the seconds; elsewhere each minute begins a line.
step() {
  local what=$1 begin=$SECONDS
  shift
  printf '[%s] %s ... ' "$who" "$what"
  tick "$what" </dev/null &
  local ticker=$!
  trap "kill $ticker 2>/dev/null || true" EXIT
  if ! "$@" >>"$log" 2>&1 </dev/null; then
    printf 'failed. The end of %s:\n\n' "$log"
    tail -n 30 "$log"
    exit 1
  fi
  kill $ticker 2>/dev/null || true
  trap - EXIT
  [ ! -t 1 ] || printf '\r[%s] %s ... ' "$who" "$what"
  printf '%d s\n' $((SECONDS - begin))
}

# Tell that a step goes on, until this is killed or the script has ended.
tick() {
  local what=$1 begin=$SECONDS told=0
  while sleep 1 && kill -0 $$ 2>/dev/null; do
    if [ -t 1 ]; then
      printf '\r[%s] %s ... %d s ' "$who" "$what" $((SECONDS - begin))
    elif ((SECONDS - begin >= told + minute)); then
      told=$((SECONDS - begin))
      printf '\n[%s] %s goes on, %d s ... ' "$who" "$what" $told
    fi
  done
}
