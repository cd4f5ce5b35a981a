#!/usr/bin/env bash
# Removes what install_pi.sh has put on a Raspberry Pi; run by `sudo make uninstall-pi`.
#
# An edited configuration and the calibrations stay; PURGE=1 removes them too, and the user.
# DESTDIR   a folder that fishd was installed into
set -euo pipefail
# shellcheck source=tools/pi_layout.sh
source "$(dirname "${BASH_SOURCE[0]}")/pi_layout.sh"
PURGE=${PURGE:-0}
NOT_LOADED=5 # exit status of systemctl where there is no such unit

remove() {
  if [[ -e $DESTDIR$1 || -L $DESTDIR$1 ]]; then
    rm -rf "${DESTDIR}${1:?}"
    step "$1: removed"
  fi
}

remove_if_empty() { rmdir "$DESTDIR$1" 2>/dev/null || true; }

stop_service() {
  local status=0
  local other
  for other in fishd-recorder fishd-camera fishd-window; do
    systemctl stop "$other.service" 2>/dev/null || true
    systemctl --quiet disable "$other.service" 2>/dev/null || true
  done
  # Whether it is active or not: one that waits for its restart is not, and would come back.
  systemctl stop fishd.service 2>/dev/null || status=$?
  case $status in
    0) step "fishd.service: stopped, the servo is released" ;;
    "$NOT_LOADED") ;;
    *) fail "fishd.service cannot be stopped; see 'systemctl status fishd'" ;;
  esac
  systemctl --quiet disable fishd.service 2>/dev/null || true
}

remove_config() {
  local config
  for config in "$CONFIG" "$CAMERA_CONFIG" "$WINDOW_CONFIG"; do
    if [[ $PURGE == 1 ]] || cmp -s "$DESTDIR$config" "$DESTDIR$(as_installed "$config")"; then
      remove "$config"
    elif [[ -e $DESTDIR$config ]]; then
      step "$config: yours, kept; PURGE=1 removes it"
    fi
    remove "$config.new"
  done
  remove_if_empty "$(dirname "$CONFIG")"
}

remove_files() {
  local entry target
  for entry in "${SYSTEM_FILES[@]}"; do
    read -r _ target <<<"$entry"
    remove "$target"
  done
  remove_if_empty /etc/systemd/system/pigpiod.service.d
  remove "$COMMANDS/fishd"
  remove "$COMMANDS/fishctl"
  remove "$COMMANDS/fishd-camera"
  remove "$COMMANDS/fishd-window"
  remove "$HOME_FOLDER"
}

remove_state() {
  remove_if_empty "$STATE_FOLDER"
  if [[ $PURGE == 1 ]]; then
    remove "$STATE_FOLDER"
    remove "$RECORDINGS"
    remove /etc/systemd/system/fishd.service.d
    remove /etc/systemd/system/fishd-recorder.service.d
    remove /etc/systemd/system/fishd-camera.service.d
    remove /etc/systemd/system/fishd-window.service.d
    remove "$WINDOW_STATE"
  elif [[ -e $DESTDIR$STATE_FOLDER ]]; then
    step "$STATE_FOLDER: calibrations, kept; PURGE=1 removes them"
  fi
  if [[ -e $DESTDIR$RECORDINGS ]]; then
    step "$RECORDINGS: recordings, kept; PURGE=1 removes them"
  fi
  if [[ -e $DESTDIR$WINDOW_STATE ]]; then
    step "$WINDOW_STATE: paired devices and recordings, kept; PURGE=1 removes them"
  fi
}

remove_user() {
  if getent passwd fishd >/dev/null; then
    userdel fishd
    step "user fishd: removed"
  fi
}

main() {
  need_root
  if systemd_runs; then stop_service; fi
  remove_config
  remove_files
  remove_state
  if systemd_runs; then
    systemctl daemon-reload
    if systemctl --quiet is-active systemd-udevd; then udevadm control --reload; fi
    if systemctl --quiet is-active pigpiod; then
      step "pigpiod runs on; for its own options again: sudo systemctl restart pigpiod"
    fi
  fi
  if real_system && [[ $PURGE == 1 ]]; then remove_user; fi
}

main
