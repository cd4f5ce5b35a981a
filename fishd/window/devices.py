"""Devices that may use the window from the network: pairing, scopes and revocation.

They are in a file of the state folder, which `fishctl window` changes, too. It holds no secret: of
tokens, only their SHA-256.
"""

import fcntl
import hashlib
import os
import secrets
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.core import files, text
from fishd.core.clock import read_boot_id
from fishd.core.decoding import decoder
from fishd.core.errors import FishdError

Scope = Literal["watch", "drive"]
INVITATION_S = 600.0
"""Time within which a token pairs a device [s]."""
MAX_INVITATIONS = 20
MAX_DEVICES = 200
MAX_NAME_CHARACTERS = 40
MAX_FILE_BYTES = 2**20
LOCK_TIMEOUT_S = 2.0
"""Longest wait for another process that changes the file [s]."""
LOCK_PERIOD_S = 0.05
"""Time between two attempts to lock the file [s]."""


class DeviceError(FishdError):
    """A device cannot be paired or revoked."""


class DevicesBusy(DeviceError):
    """The file of the devices cannot be changed now, maybe later."""


class Device(Struct, frozen=True):
    """A paired device."""

    id: str
    name: str
    scope: Scope
    token: str
    """SHA-256 of the token in its cookie, in hexadecimal."""
    paired: float
    """Time at which it was paired [s, unix]."""
    seen: float
    """Time at which it was last seen, to the hour [s, unix]."""


class Invitation(Struct, frozen=True):
    """A token that pairs one device."""

    token: str
    """SHA-256 of the token, in hexadecimal."""
    scope: Scope
    until: float
    """Time at which it expires, since the start of the machine [s]."""
    boot: str = ""
    """Name of that run of the machine, with which it expires, too."""

    @property
    def is_valid(self) -> bool:
        """Whether it pairs a device."""
        return self.boot == read_boot_id() and _boot_time() < self.until


class _Content(Struct, frozen=True):
    """Content of the file."""

    devices: tuple[Device, ...] = ()
    invitations: tuple[Invitation, ...] = ()


_decode: Callable[[bytes], _Content] = decoder(_Content)


class Devices:
    """The paired devices in the state folder; it follows changes that other processes make.

    Each method reads the disk, and raises `DeviceError` if that is damaged or does not answer.
    """

    def __init__(self, folder: Path) -> None:
        """folder: is created if missing; raises `DeviceError`"""
        self._folder, self._path = folder, folder / "devices.json"
        self._copy = folder / "devices.copy.json"
        remedy = "set state in the settings"
        with files.os_errors(DeviceError, f"{folder} cannot be created", remedy):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        mode = stat.S_IMODE(folder.stat().st_mode)
        if mode & 0o022:
            raise DeviceError(
                f"{folder}: other users may change it (mode {mode:o}), and so pair devices; run "
                f"'chmod go-w {folder}'"
            )
        self._content, self._version = _Content(), (0, 0, 0)

    def invite(self, scope: Scope, seconds: float = INVITATION_S) -> str:
        """Return a new token that pairs one device within this time."""
        token = secrets.token_urlsafe(16)
        invitation = Invitation(hash_token(token), scope, _boot_time() + seconds, read_boot_id())
        with self._changing() as content:
            valid = [entry for entry in content.invitations if entry.is_valid]
            kept = (*valid[1 - MAX_INVITATIONS :], invitation)
            self._write(replace(content, invitations=kept))
        return token

    def pair(self, token: str, name: str) -> tuple[Device, str]:
        """Use up a token; return the new device, and the token for its cookie."""
        digest, secret = hash_token(token), secrets.token_urlsafe(32)
        with self._changing() as content:
            match = next((entry for entry in content.invitations if entry.token == digest), None)
            if match is None or not match.is_valid:
                raise DeviceError(
                    "this link was used already, or has expired: run 'fishctl window pair' again"
                )
            if len(content.devices) >= MAX_DEVICES:
                raise DeviceError(
                    f"{MAX_DEVICES} devices are paired: revoke some with 'fishctl window revoke'"
                )
            taken = {device.name for device in content.devices}
            wanted = text.line(name, MAX_NAME_CHARACTERS) or "device"
            device = Device(
                id=secrets.token_hex(4),
                name=files.unused_name(wanted, taken.__contains__, " "),
                scope=match.scope,
                token=hash_token(secret),
                paired=time.time(),
                seen=time.time(),
            )
            others = tuple(entry for entry in content.invitations if entry is not match)
            self._write(_Content((*content.devices, device), others))
        return device, secret

    def all(self) -> tuple[Device, ...]:
        """Return the devices in the file."""
        if self._version_now() != self._version:
            self._read()
        return self._content.devices

    def read_copy(self) -> tuple[Device, ...]:
        """Return the devices in the copy of the file; none if it cannot be read, either."""
        try:
            return self._decode_file(self._copy).devices
        except DeviceError:
            return ()

    def note_seen(self, times: Mapping[str, float]) -> None:
        """Store when devices were seen [s, unix], by their ids; raise `DevicesBusy`."""
        with self._changing(timeout=0.0) as content:
            devices = (replace(d, seen=times.get(d.id, d.seen)) for d in content.devices)
            self._write(replace(content, devices=tuple(devices)))

    def revoke(self, name: str) -> Device:
        """Remove the device with this name or id; raise `DeviceError` if there is none."""
        stored = self.all()
        match = next((entry for entry in stored if name in (entry.name, entry.id)), None)
        if match is None:
            known = ", ".join(entry.name for entry in stored) or "there is none"
            raise DeviceError(f"no device is named '{text.quoted(name)}'; paired: {known}")
        with self._changing() as content:
            others = tuple(entry for entry in content.devices if entry.id != match.id)
            self._write(replace(content, devices=others), forgets=True)
        return match

    @contextmanager
    def _changing(self, timeout: float = LOCK_TIMEOUT_S) -> Iterator[_Content]:
        """Yield the newest content, while no other process changes it; raise `DevicesBusy`.

        timeout: longest wait for another process [s]
        """
        deadline = time.monotonic() + timeout
        descriptor = os.open(self._folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            _give_to_owner(self._folder, descriptor)
            while not _try_to_lock(descriptor):
                if time.monotonic() >= deadline:
                    raise DevicesBusy(f"{self._folder}/lock is held by another process; end that")
                time.sleep(LOCK_PERIOD_S)
            self._read()
            yield self._content
        finally:
            os.close(descriptor)

    def _write(self, content: _Content, *, forgets: bool = False) -> None:
        """Write the file, and a copy by which the devices are known where the file is damaged.

        forgets: whether nothing changes unless the copy is written or removed: a revoked device in
            it would regain its access where the file is damaged later
        """
        payload = msgspec.json.format(msgspec.json.encode(content))
        try:
            self._write_file(self._copy, payload)
        except OSError:
            if forgets:
                self._remove_copy()
        self._write_file(self._path, payload)
        self._content, self._version = content, self._version_now()

    def _remove_copy(self) -> None:
        try:
            self._copy.unlink(missing_ok=True)
        except OSError as error:
            raise DeviceError(
                f"{self._copy} can be neither written nor removed: {error.strerror}; the device "
                "stays paired: remove that file, and revoke the device again"
            ) from None

    def _write_file(self, path: Path, payload: bytes) -> None:
        new = path.with_suffix(".new")
        new.unlink(missing_ok=True)
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(descriptor)
            _give_to_owner(self._folder, descriptor)
        new.replace(path)

    def _read(self) -> None:
        version = self._version_now()
        self._content = self._decode_file(self._path)
        self._version = version

    def _decode_file(self, path: Path) -> _Content:
        try:
            return _decode(files.read(path, MAX_FILE_BYTES, "the paired devices"))
        except files.NoFile:
            if self._content.devices and not (self._folder / "lock").exists():
                raise DeviceError(f"{path} is gone with its folder; restore that") from None
            return _Content()
        except (files.FileProblem, msgspec.DecodeError) as error:
            raise DeviceError(
                f"{path}: {text.error_message(error)}; replace it by {self._copy.name}, which is a "
                "copy of it, or remove it and pair the devices again"
            ) from None

    def _version_now(self) -> tuple[int, int, int]:
        """Return values that differ for another content of the file."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return 0, 0, 0
        return status.st_ino, status.st_mtime_ns, status.st_size


def _try_to_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _boot_time() -> float:
    """Return the time since this machine has started [s], which no step of its clock moves."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _give_to_owner(folder: Path, descriptor: int) -> None:
    """Let a file that root creates belong to the owner of the folder, such as the service."""
    if os.geteuid() == 0:
        owner = folder.stat()
        os.fchown(descriptor, owner.st_uid, owner.st_gid)


def hash_token(token: str) -> str:
    """Return the SHA-256 of a token, in hexadecimal."""
    return hashlib.sha256(token.encode("utf-8", "replace")).hexdigest()
