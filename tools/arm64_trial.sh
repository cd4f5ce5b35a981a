#!/usr/bin/env bash
# Installs the Debian package on arm64 Debian 12 and 13, in chroots under qemu-user, and compares a simulation
# there with the same on this machine. Needs root, and build/docs of `make docs`.
#
#   sudo tools/arm64_trial.sh [SUITE ...]     bookworm and trixie, where none is named
#
# WORK   a folder that keeps the bare Debians and the logs; /var/tmp/fishd-arm64-trial if not set
# DEBIAN what debootstrap takes for a mirror, if not its own
# How apt reaches its packages is inherited from this machine.
set -euo pipefail
checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
WORK=${WORK:-/var/tmp/fishd-arm64-trial}
BIN=${BIN:-$checkout/.venv/bin}
SIMULATION=(simulate swing --seconds 60 --json)
MOST_SPACE=400 # MB of /usr/lib/fishd
LONGEST=2700   # s that a step may take
# That of a Pi 4. No Pi has SVE, which qemu offers from itself and, in 7.2, computes NaN with.
PROCESSOR=cortex-a72

fail() {
  printf 'arm64_trial: %s\n' "$*" >&2
  exit 1
}

check_machine() {
  ((EUID == 0)) || fail "not run here: needs root"
  local tool
  for tool in debootstrap qemu-aarch64-static update-binfmts unshare; do
    command -v "$tool" >/dev/null ||
      fail "not run here: $tool is missing: apt install debootstrap qemu-user-static binfmt-support util-linux"
  done
  [[ -x $BIN/fishctl ]] || fail "$BIN/fishctl is missing, to compare with: make test; or name its folder with BIN"
  [[ $(uname -m) == aarch64 || -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ]] && return
  [[ -e /proc/sys/fs/binfmt_misc/register ]] ||
    mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc ||
    fail "not run here: this kernel has no binfmt_misc, so it does not start programs for arm64"
  update-binfmts --enable qemu-aarch64
}

# This machine's way to Debian's packages, for the root.
connect() {
  local root=$1
  cp --dereference /etc/resolv.conf "$root/etc/resolv.conf"
  apt-config dump | grep -E '^Acquire::(https?::|Check-)' >"$root/etc/apt/apt.conf.d/99host" || true
}

# Runs a command in the root, with nothing of this machine but its way to the network.
inside() {
  local root=$1
  shift
  # In namespaces of its own: mounts and processes are gone with it.
  # shellcheck disable=SC2016
  timeout "$LONGEST" unshare --mount --pid --fork --kill-child bash -c '
    mount -t proc proc "$0/proc" && mount --rbind /dev "$0/dev" && exec chroot "$0" env -i "$@"' \
    "$root" QEMU_CPU="$PROCESSOR" PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root \
    LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive "$@"
}

# A bare Debian; kept for the next time.
make_base() {
  local suite=$1 base=$WORK/$1.base
  [[ ! -e $base.made ]] || return 0
  rm -rf "$base"
  timeout "$LONGEST" debootstrap --arch=arm64 --variant=minbase --include=ca-certificates \
    "$suite" "$base" ${DEBIAN:+"$DEBIAN"} &&
    connect "$base" && inside "$base" apt-get update && touch "$base.made"
}

# A copy of it with the package.
make_root() {
  local suite=$1 root=$2 python
  python=$([[ $suite == bookworm ]] && echo 3.11 || echo 3.13)
  rm -rf "$root" "$WORK"/*"~deb"*.deb
  cp --archive "$WORK/$suite.base" "$root"
  connect "$root"
  "$BIN/python" "$checkout/tools/deb" --fast --machine arm64 --python "$python" --to "$WORK"
  mv "$WORK"/fishd_*.deb "$root/root/fishd.deb"
  cp "$checkout/tools/install_pi.sh" "$root/root"
}

# Whether two reports of `fishctl simulate` agree; how fast the machines were does not count.
compare() {
  python3 - "$@" <<'PYTHON'
import json, math, sys

first, second = (json.load(open(path)) for path in sys.argv[1:])
for report in (first, second):
    report.update(report.pop("quantities"))
    for name in ("microseconds_per_tick", "real_time_factor"):
        del report[name]
numbers = [name for name, value in first.items() if isinstance(value, float)]
different = [
    name
    for name in first.keys() | second.keys()
    if name not in numbers and first.get(name) != second.get(name)
]
gaps = {
    name: abs(first[name] - second[name]) / max(abs(first[name]), 1.0)
    if isinstance(second.get(name), float) and math.isfinite(second[name])
    else math.inf
    for name in numbers
}
print(f"{len(numbers)} numbers differ by {max(gaps.values()):.1e} at most")
for name in different:
    print(f"{name}: {first.get(name)} here, {second.get(name)} there")
sys.exit(bool(different) or max(gaps.values()) > 1e-9)
PYTHON
}

try_suite() {
  local suite=$1 root=$WORK/$1 status=0 size
  make_base "$suite" >"$WORK/$suite.log" 2>&1 ||
    fail "$suite: no Debian could be made; see $WORK/$suite.log"
  make_root "$suite" "$root"
  inside "$root" env FISHD_DEB=/root/fishd.deb /root/install_pi.sh >"$WORK/$suite.install.log" 2>&1 || status=$?
  sed "s/^/$suite: /" "$WORK/$suite.install.log"
  echo "$suite: install_pi.sh: exit status $status"
  ((status == 0)) || return 1
  size=$(du --summarize --block-size=1MB "$root/usr/lib/fishd" | cut -f 1)
  echo "$suite: /usr/lib/fishd: $size MB"
  ((size <= MOST_SPACE)) || { echo "$suite: more than $MOST_SPACE MB" && return 1; }
  inside "$root" fishctl "${SIMULATION[@]}" >"$WORK/$suite.json"
  "$BIN/fishctl" "${SIMULATION[@]}" >"$WORK/host.json"
  compare "$WORK/host.json" "$WORK/$suite.json" >"$WORK/$suite.comparison" || status=$?
  echo "$suite: fishctl ${SIMULATION[*]}: $(cat "$WORK/$suite.comparison")"
  return "$status"
}

main() {
  local suite failed=0
  check_machine
  mkdir -p "$WORK"
  if (($# == 0)); then set -- bookworm trixie; fi
  if (($# == 1)); then
    try_suite "$1"
    return
  fi
  for suite in "$@"; do
    "${BASH_SOURCE[0]}" "$suite" || failed=1 # a process of its own, which its first error ends
  done
  return "$failed"
}

main "$@"
