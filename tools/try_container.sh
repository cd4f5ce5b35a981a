#!/usr/bin/env bash
# Builds the container image and runs it as docs/how-to/install.md says: its fish is healthy, its page answers.
#
# ENGINE   docker or podman, or a program that is called like them; the first that is installed, if not set
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
ENGINE=${ENGINE:-$(command -v docker || command -v podman || true)}

refuse() {
  echo "not run here: $*" >&2
  exit 1
}

[[ -n $ENGINE ]] || refuse "neither docker nor podman is installed"
"$ENGINE" build -t fishd .
reason=$("$ENGINE" run --rm fishd true 2>&1) || refuse "$ENGINE runs no container: ${reason##*$'\n'}"
container=$("$ENGINE" run --rm --detach -p 127.0.0.1:8880:8880 fishd)
trap '"$ENGINE" stop "$container"' EXIT
for _ in {1..60}; do
  if "$ENGINE" logs "$container" 2>&1 | grep -F http://localhost:8880/; then break; fi
  sleep 1
done
"$ENGINE" exec "$container" fishctl status
"$ENGINE" exec "$container" id -un | grep -x fish
curl --fail --silent --show-error --output /dev/null http://127.0.0.1:8880/
