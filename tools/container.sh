#!/usr/bin/env bash
# Runs a simulated fish and its page in a container until SIGTERM, or until one of them ends.
set -euo pipefail
trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT
trap exit INT TERM
if [[ ! -e fishd.yaml ]]; then fishctl config example simulated --to fishd.yaml; fi
fishd --config fishd.yaml &
fishd-window --listen 0.0.0.0:8880 &
until [[ -e $HOME/.local/state/fishd-window ]] && fishctl window pair --listen 0.0.0.0:8880 \
  --url "${PAGE_URL:-http://localhost:8880/}" 2>pair.log; do sleep 0.2; done
wait -n
