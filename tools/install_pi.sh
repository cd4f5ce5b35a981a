#!/usr/bin/env bash
# Installs fishd on a Raspberry Pi, or renews it; run by `sudo make install-pi`.
#
# PYTHON       the Python to use, python3 if not set
# FISHD_WHEEL  a wheel to install instead of building one from this checkout
# FISHD_GPIO   rpi-gpio or rpi-lgpio, if not what suits this Pi; or none, for a robot without E-stop
#              button and status light. Where it cannot be had, all else is installed, and it says so
# FISHD_CAMERA yes: install what fishd-camera needs, too; once it is there, it is renewed
# FISHD_WINDOW yes: install what the page fishd-window needs, too; once it is there, it is renewed
# FISHD_LOCK   no: install the newest packages that fishd permits, instead of those of tools/locks
# DESTDIR      a folder to install into, without touching the running system
# pip's own variables work too: PIP_NO_INDEX=1 PIP_FIND_LINKS=FOLDER installs without a network, and
# without the lock, as wheels that were built elsewhere have other hashes.
set -euo pipefail
umask 022
checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
# shellcheck source=tools/pi_layout.sh
source "$checkout/tools/pi_layout.sh"
PYTHON=${PYTHON:-python3}
venv=$DESTDIR$HOME_FOLDER

# Which package provides RPi: RPi.GPIO fails on a Pi 5, and its edges from kernel 6.6 on.
gpio_extra() {
  local model=$1 debian=$2 kernel=$3 major minor
  IFS=.- read -r major minor _ <<<"$kernel"
  if [[ $model =~ (Pi|Module)\ 5|Pi\ 500 ]] || ((debian >= 13 || major > 6 || (major == 6 && minor >= 6))); then
    echo rpi-lgpio
  else
    echo rpi-gpio
  fi
}

pi_model() { tr -d '\0' 2>/dev/null </proc/device-tree/model || true; }

debian_version() {
  local version
  version=$(sed -n 's/^VERSION_ID="\{0,1\}\([0-9]\{1,\}\).*/\1/p' /etc/os-release 2>/dev/null || true)
  echo "${version:-0}"
}

check_python() {
  "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null ||
    fail "Python 3.11 or later is needed; name one with PYTHON=..., or use Debian 12 or later"
  "$PYTHON" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "Python cannot make virtual environments: sudo apt install python3-venv"
  if real_system && [[ $("$PYTHON" -c 'import sys; print(sys.base_prefix)') =~ ^/(home|root)/ ]]; then
    fail "$PYTHON is in a home folder, where the service cannot see it; PYTHON=/usr/bin/python3?"
  fi
}

# A tick takes too long on the one slow core of these.
check_board() {
  if real_system && [[ $(about_python "$PYTHON") == *-armv6l ]]; then
    fail "a Raspberry Pi Zero, Zero W or 1 is too slow for fishd; a Zero 2 W, 3, 4 or 5 is needed"
  fi
}

# A Python that was upgraded, or taken away, leaves a folder behind that no longer runs.
make_venv() {
  local version
  version=$("$PYTHON" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  if [[ $("$venv/bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) == "$version" ]]; then
    step "$HOME_FOLDER: has Python $version"
    return
  fi
  rm -rf "${venv:?}"/{bin,lib,lib64,include,pyvenv.cfg}
  "$PYTHON" -m venv "$venv"
  step "$HOME_FOLDER: made with Python $version"
}

# What the controller `ppo` and recordings need has wheels for 64 bits only. The kernel does not
# tell: 32-bit Raspberry Pi OS boots a 64-bit one on a Pi 4 and 5, and `uname -m` says aarch64 there.
core_extras() {
  local bits=$1 platform=$2
  case $bits-$platform in
    64-linux-aarch64 | 64-linux-x86_64) echo pi,record,policy ;;
    *) echo pi ;;
  esac
}

# Bits of a pointer, and platform, of a Python.
about_python() {
  "$1" -c 'import struct, sysconfig; print(struct.calcsize("P") * 8, sysconfig.get_platform())'
}

# -I: not what lies in the folder that this is started from.
pip() { "$venv/bin/python" -I -m pip --quiet --disable-pip-version-check "$@"; }

# The same, with its complaints in a file, for `why`.
try_pip() { pip "$@" 2>"$workspace/pip.log"; }

# What pip's complaints amount to: hash, build, network, space or other.
why() {
  local log=$1
  if grep -q 'DO NOT MATCH THE HASHES' "$log"; then
    echo hash
  elif grep -qE 'Failed building wheel|Building wheel for .* did not run|metadata-generation-failed' "$log"; then
    echo build
  elif grep -qE 'connection broken|Connection(Pool|Error| refused| reset)|name resolution|timed out|(Proxy|SSL|HTTP)Error|Network is unreachable' "$log"; then
    echo network
  elif grep -q 'Failed to build' "$log"; then
    echo build
  elif grep -q 'No space left on device' "$log"; then
    echo space
  else
    echo other
  fi
}

# How to mend what pip complained about, where these packages build what has no wheel.
mend() {
  case $(why "$workspace/pip.log") in
    build) echo "a package has no wheel for this Python and could not be built: sudo apt install $1" ;;
    hash) echo "a package is another file than that of tools/locks: do not trust it; FISHD_LOCK=no takes it" ;;
    network) echo "the network failed, not fishd: check it" ;;
    space) echo "the disk is full: make room" ;;
    other) echo "see what pip says" ;;
  esac
}

give_up() {
  cat "$workspace/pip.log" >&2
  fail "$1; $(mend "gcc python3-dev"), then run this again"
}

# Writes what these requirements need into locked.txt, with the versions and hashes of the lock of this
# Python; nothing, where there is none. pip compares hashes only in a list of all packages.
lock_packages() {
  local version lock
  version=$("$venv/bin/python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  lock=$checkout/tools/locks/python$version.txt
  : >"$workspace/locked.txt"
  [[ -e $lock && ${FISHD_LOCK:-} != no && ${PIP_NO_INDEX:-0} == 0 ]] || return 0
  [[ $(about_python "$PYTHON") == "64 linux-"* ]] || return 0
  sed -nE 's/^([^ #]+==[^ ]+).*/\1/p' "$lock" >"$workspace/versions.txt"
  try_pip install --dry-run --ignore-installed --constraint "$workspace/versions.txt" \
    --report "$workspace/report.json" "$@" || return
  "$venv/bin/python" -I - "$workspace/report.json" "$lock" >"$workspace/locked.txt" <<'PYTHON'
import json, re, sys

with open(sys.argv[1]) as report, open(sys.argv[2]) as lock:
    packages = {package["metadata"]["name"] for package in json.load(report)["install"]}
    entries = re.split(r"^(?=\w)", lock.read(), flags=re.MULTILINE)
names = {re.sub(r"[-_.]+", "-", name).lower() for name in packages}
print(*(entry for entry in entries if entry.partition("==")[0] in names), sep="", end="")
PYTHON
  step "packages: versions and hashes are those of tools/locks/python$version.txt"
}

# With all hashes where locked.txt lists packages, else what these requirements resolve to.
pip_locked() {
  local action=("${@:1:$#-1}")
  if [[ -s $workspace/locked.txt ]]; then
    try_pip "${action[@]}" --require-hashes --no-deps --requirement "$workspace/locked.txt"
  else
    try_pip "$@"
  fi
}

install_package() {
  local extras wheel=${FISHD_WHEEL:-}
  # shellcheck disable=SC2046
  extras=$(core_extras $(about_python "$PYTHON"))
  if [[ ${FISHD_CAMERA:-} == yes ]] || has linuxpy; then extras+=,camera; fi
  if [[ ${FISHD_WINDOW:-} == yes ]] || has segno; then extras+=,window; fi
  if [[ -z $wheel ]]; then
    try_pip wheel --no-deps --wheel-dir "$workspace" "$checkout" || give_up "building fishd failed"
    wheel=$(echo "$workspace"/fishd-*.whl)
  fi
  { lock_packages "${wheel}[$extras]" && pip_locked install "${wheel}[$extras]"; } ||
    give_up "installing fishd's packages failed"
  pip install --force-reinstall --no-deps "$wheel" # the same version may have other contents
  step "fishd $("$venv/bin/python" -I -c 'import fishd; print(fishd.__version__)') with the extras $extras"
}

# What fishd's extra $1 asks for, such as rpi-lgpio<1,>=0.6.
requirement() {
  "$venv/bin/python" -I - "$1" <<'PYTHON'
import importlib.metadata, sys

for line in importlib.metadata.requires("fishd"):
    package, _, marker = line.partition(";")
    if f"extra == '{sys.argv[1]}'" in marker.replace('"', "'"):
        print(package.strip())
PYTHON
}

# E-stop button and status light are optional, and so is what drives them: without it fishd is whole.
install_gpio() {
  local extra=$1 wanted other packages="gcc python3-dev"
  [[ $extra != none ]] || return 0
  wanted=$(requirement "$extra")
  other=$([[ $extra == rpi-gpio ]] && echo rpi-lgpio || echo RPi.GPIO)
  if has "$extra" && ! has "$other" && pip install --dry-run --no-index "$wanted" >/dev/null 2>&1; then
    step "$extra: there, for E-stop button and status light"
    return
  fi
  if [[ $extra == rpi-lgpio ]]; then packages="swig $packages"; fi
  # PYPI: lgpio has its C library in its sources, and builds that instead of asking for the system's.
  if ! { lock_packages "$wanted" && PYPI=1 pip_locked wheel --wheel-dir "$workspace/gpio" "$wanted"; }; then
    grep -E '^ERROR|error:' "$workspace/pip.log" | tail -n 3 | sed 's/^ */  pip: /' || true
    step "E-stop button and status light are NOT available: no $extra. All else is installed."
    step "To have them: $(mend "$packages"); then: sudo make install-pi${FISHD_GPIO:+ FISHD_GPIO=$extra}"
    step "A robot without them needs nothing more; FISHD_GPIO=none does not try"
    return
  fi
  # Both packages put their files into the same folder RPi: one at a time.
  if has "$other"; then
    pip uninstall --yes "$other"
    step "$other: removed, it excludes $extra"
  fi
  pip install --force-reinstall --no-deps "$workspace"/gpio/*.whl
  step "$extra: installed, for E-stop button and status light"
}

has() {
  "$venv/bin/python" -I -c 'import importlib.metadata, sys; importlib.metadata.version(sys.argv[1])' "$1" 2>/dev/null
}

# What is in the folder must not know of DESTDIR, it will be gone when the folder is in its place.
forget_destdir() {
  real_system && return
  local file
  while IFS= read -r file; do
    sed -i "s|$DESTDIR||g" "$file"
  done < <(grep -rlI --exclude-dir=__pycache__ -F "$DESTDIR" "$venv/bin" "$venv/pyvenv.cfg" || true)
}

put() { install -D -m 0644 "$1" "$DESTDIR$2"; }

install_config() {
  install_one_config "$checkout/config/pi.yaml" "$CONFIG"
  install_one_config "$checkout/config/camera.yaml" "$CAMERA_CONFIG"
  install_one_config "$checkout/config/window.yaml" "$WINDOW_CONFIG"
  # Its group is set by systemd-tmpfiles, once there is one.
  chmod 0640 "$DESTDIR$CAMERA_CONFIG"
  step "$CAMERA_CONFIG: for root and group fishd only, as it may hold a camera's password"
}

install_one_config() {
  local new=$1 target=$2 there=$DESTDIR$2 copy
  copy=$(as_installed "$target")
  if [[ -e $there ]] && ! cmp -s "$there" "$DESTDIR$copy" && ! cmp -s "$there" "$new"; then
    if cmp -s "$new" "$DESTDIR$copy"; then
      step "$target: yours, kept"
    else
      put "$new" "$target.new"
      put "$new" "$copy"
      step "$target: yours, kept; what is new is in $target.new"
    fi
    return
  fi
  put "$new" "$target"
  put "$new" "$copy"
  rm -f "$there.new"
  step "$target: installed"
}

install_files() {
  local entry source target
  mkdir -p "$DESTDIR$COMMANDS"
  for source in fishd fishctl fishd-camera fishd-window; do
    ln -sfn "$HOME_FOLDER/bin/$source" "$DESTDIR$COMMANDS/$source"
    step "$COMMANDS/$source: installed"
  done
  for entry in "${SYSTEM_FILES[@]}"; do
    read -r source target <<<"$entry"
    put "$checkout/systemd/$source" "$target"
    step "$target: installed"
  done
}

take_effect() {
  systemd-sysusers /etc/sysusers.d/fishd.conf
  systemd-tmpfiles --create /etc/tmpfiles.d/fishd.conf
  step "user fishd, groups i2c and gpio: there"
  systemctl daemon-reload
  if systemctl --quiet is-active systemd-udevd; then
    modprobe i2c-dev 2>/dev/null || step "module i2c-dev: not loaded; see 'fishctl doctor'"
    udevadm control --reload
    udevadm trigger --subsystem-match=i2c-dev --subsystem-match=gpio --subsystem-match=pwm
    step "udev: has the new rules"
  fi
  systemctl --quiet enable fishd.service
  step "fishd.service: enabled, starts with the next boot"
  if ! systemctl --quiet is-enabled fishd-recorder.service 2>/dev/null; then
    step "to record always: sudo systemctl enable --now fishd-recorder"
  fi
  if ! systemctl --quiet is-enabled fishd-camera.service 2>/dev/null; then
    step "to serve a camera: $(camera_next)"
  fi
  if ! systemctl --quiet is-enabled fishd-window.service 2>/dev/null; then
    step "to serve a page of the fish: $(window_next)"
  fi
}

# What a camera still takes.
camera_next() {
  has linuxpy || echo -n "sudo make install-pi FISHD_CAMERA=yes; "
  echo "look over $CAMERA_CONFIG; sudo systemctl enable --now fishd-camera"
}

# What the page still takes.
window_next() {
  has segno || echo -n "sudo make install-pi FISHD_WINDOW=yes; "
  echo "sudo systemctl enable --now fishd-window"
}

say_what_next() {
  if systemctl --quiet is-active pigpiod; then
    step "pigpiod runs as before; for its new options: sudo systemctl restart pigpiod"
  elif ! command -v pigpiod >/dev/null; then
    step "there is no pigpiod: sudo apt install pigpio, or servo.driver: sysfs-pwm in $CONFIG"
  fi
  step "who may use fishctl: sudo usermod -aG fishd USER, then log in again"
  if systemctl --quiet is-active fishd; then
    step "the old fishd runs on; for the new one: sudo systemctl restart fishd"
  else
    step "look it over: sudo -u fishd fishctl doctor --config $CONFIG; then: sudo systemctl start fishd"
  fi
}

main() {
  local extra
  need_root
  check_python
  check_board
  workspace=$(mktemp -d)
  trap 'rm -rf "$workspace"' EXIT
  extra=${FISHD_GPIO:-$(gpio_extra "$(pi_model)" "$(debian_version)" "$(uname -r)")}
  [[ $extra =~ ^(rpi-gpio|rpi-lgpio|none)$ ]] || fail "FISHD_GPIO=$extra: rpi-gpio, rpi-lgpio or none"
  make_venv
  install_package
  install_gpio "$extra"
  forget_destdir
  install_config
  install_files
  if systemd_runs; then
    take_effect
    say_what_next
  else
    step "systemd does not run here: nothing was started or enabled"
  fi
}

if [[ ${BASH_SOURCE[0]} == "$0" ]]; then
  main
fi
