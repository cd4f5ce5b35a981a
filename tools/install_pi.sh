#!/usr/bin/env bash
# Installs the Debian package of fishd on a Raspberry Pi, or renews it, and sets up the I2C bus and
# pigpiod, which are not the package's; run by `sudo make install-pi`.
#
# FISHD_DEB   the package; if not set, the newest one in dist/ for this Debian and processor
# DISK        a folder whose files replace those of the running system, for a test
set -euo pipefail
DIST=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)/dist
DISK=${DISK:-}
BOOT_CONFIG=$DISK/boot/firmware/config.txt
MANUAL=docs/how-to/install.md

step() { printf '%s\n' "$*"; }

fail() {
  printf 'install_pi.sh: %s\n' "$*" >&2
  exit 1
}

find_package() {
  local machine debian python package newest=
  machine=$(dpkg --print-architecture)
  [[ $machine =~ ^a(rm|md)64$ ]] ||
    fail "there is no package for $machine; install the 64-bit edition of Raspberry Pi OS"
  debian=$(sed -n 's/^VERSION_ID="\{0,1\}\([0-9.]*\).*/\1/p' "$DISK/etc/os-release")
  case $debian in
    12) python=3.11 ;;
    13) python=3.13 ;;
    *) fail "this is release ${debian:-(none)}; Debian or Raspberry Pi OS 12 or 13 is needed" ;;
  esac
  for package in "$DIST"/fishd_*"~deb${debian}_$machine.deb"; do
    if [[ $package -nt $newest ]]; then newest=$package; fi
  done
  [[ -n $newest ]] || fail "no package in $DIST is for Debian $debian and $machine; \
run make deb DEB_MACHINE=$machine DEB_PYTHON=$python, or name one with FISHD_DEB=FILE"
  FISHD_DEB=$newest
}

set_up_bus() {
  if ! command -v raspi-config >/dev/null; then
    step "I2C bus: there is no raspi-config; enable the bus as step 1 of $MANUAL says"
    return
  fi
  raspi-config nonint do_i2c 0
  if ! grep -q '^dtparam=i2c_arm_baudrate=' "$BOOT_CONFIG"; then
    printf '\n[all]\ndtparam=i2c_arm_baudrate=400000\n' >>"$BOOT_CONFIG"
  fi
  step "I2C bus: enabled; its speed in $BOOT_CONFIG holds from the next boot on"
}

set_up_pigpiod() {
  local model candidate
  model=$(tr -d '\0' 2>/dev/null <"$DISK/proc/device-tree/model" || true)
  candidate=$(LC_ALL=C apt-cache policy pigpio | sed -n 's/^ *Candidate: //p')
  if [[ $model =~ (Pi|Module)\ 5 || ${candidate:-(none)} == "(none)" ]]; then
    step "pigpiod: not for this system; the kernel drives the servo, as step 2b of $MANUAL says"
    return
  fi
  apt-get install --yes pigpio
  systemctl --quiet enable pigpiod
  if systemctl --quiet is-active pigpiod; then
    step "pigpiod: runs as before; for fishd's options: sudo systemctl restart pigpiod"
  else
    step "pigpiod: enabled, starts with the next boot"
  fi
}

[[ -n $DISK ]] || ((EUID == 0)) || fail "needs root: run it with sudo"
[[ -n ${FISHD_DEB:-} ]] || find_package
[[ -e $FISHD_DEB ]] || fail "$FISHD_DEB does not exist"
apt-get install --yes "$(realpath "$FISHD_DEB")"
set_up_bus
set_up_pigpiod
