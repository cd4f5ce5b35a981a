# What install_pi.sh and uninstall_pi.sh agree on: where things are on a Pi. Both source this file.
# shellcheck shell=bash disable=SC2034
# The two scripts use these variables.

DESTDIR=${DESTDIR:-}
HOME_FOLDER=/opt/fishd
CONFIG=/etc/fishd/fishd.yaml
CAMERA_CONFIG=/etc/fishd/camera.yaml
WINDOW_CONFIG=/etc/fishd/window.yaml
STATE_FOLDER=/var/lib/fishd
RECORDINGS=/var/lib/fishd-recorder
WINDOW_STATE=/var/lib/fishd-window
COMMANDS=/usr/local/bin

# Files of systemd/, and where they go. Under /etc, so that they do not collide with packages.
SYSTEM_FILES=(
  "fishd.service /etc/systemd/system/fishd.service"
  "fishd-failure.service /etc/systemd/system/fishd-failure.service"
  "fishd-camera.service /etc/systemd/system/fishd-camera.service"
  "fishd-window.service /etc/systemd/system/fishd-window.service"
  "fishd-recorder.service /etc/systemd/system/fishd-recorder.service"
  "pigpiod.service.d/fishd.conf /etc/systemd/system/pigpiod.service.d/fishd.conf"
  "sysusers.d/fishd.conf /etc/sysusers.d/fishd.conf"
  "tmpfiles.d/fishd.conf /etc/tmpfiles.d/fishd.conf"
  "modules-load.d/fishd.conf /etc/modules-load.d/fishd.conf"
  "udev/rules.d/60-fishd.rules /etc/udev/rules.d/60-fishd.rules"
)

# The copy of a configuration as it was installed, by which one is known that nobody has edited.
as_installed() { echo "$HOME_FOLDER/$(basename "$1").installed"; }

step() { printf '%s\n' "$*"; }

fail() {
  printf '%s: %s\n' "$(basename "$0")" "$*" >&2
  exit 1
}

# Into a folder, nothing of the running system is touched.
real_system() { [[ -z $DESTDIR ]]; }

# systemd runs: not so in a chroot or while an image is built.
systemd_runs() { real_system && [[ -d /run/systemd/system ]]; }

need_root() {
  if real_system && ((EUID != 0)); then
    fail "needs root: run it with sudo, or set DESTDIR to install into a folder"
  fi
}
