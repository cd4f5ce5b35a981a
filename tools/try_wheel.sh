#!/usr/bin/env bash
# Uses an installed fishd as a newcomer would, in the empty working folder; run by tools/release.py.
set -euo pipefail
export FISHD_ENDPOINT=ipc://$PWD/control
fishd --version
fishd-window --version
fishctl config example simulated --to fishd.yaml
fishd --config fishd.yaml --set "control.address=$FISHD_ENDPOINT" \
  --set telemetry.address=tcp://127.0.0.1:0 2>fishd.log &
daemon=$!
trap 'kill "$daemon" && wait "$daemon"' EXIT
for _ in {1..300}; do
  if [[ -S control ]]; then break; fi
  sleep 0.1
done
fishctl status
fishctl set-controller swing
fishctl record swim --seconds 3
fishctl stop
fishctl plot swim
test -s swim.png
fishctl simulate ppo --policy default-fish --seconds 20
