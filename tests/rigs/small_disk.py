"""Small disk in a file, mounted for a trial, that becomes full, read-only or stalls."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

from common.processes import call

IMAGE_BYTES = 64 * 2**20
"""Size of the disk [bytes]; a recording ends where 16 MB are left."""


class NoDisk(Exception):
    """No file system can be mounted on this machine."""


class Disk:
    """Small disk, mounted at `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def make_read_only(self) -> None:
        """Let writes fail, as the kernel does after an error of the disk."""
        device = call("findmnt", "-no", "SOURCE", str(self.folder)).stdout.strip()
        Path(f"/sys/fs/ext4/{Path(device).name}/trigger_fs_error").write_text("a test")

    def fill(self) -> None:
        """Leave no room."""
        assert self.folder.is_mount()  # never the disk of the machine
        with contextlib.suppress(OSError), (self.folder / "filler").open("wb") as filler:
            while True:
                filler.write(bytes(2**20))

    def empty(self) -> None:
        """Make room again."""
        (self.folder / "filler").unlink()

    @contextlib.contextmanager
    def stalled(self) -> Iterator[None]:
        """Let all writes wait."""
        subprocess.run(["fsfreeze", "-f", str(self.folder)], check=True)
        try:
            yield
        finally:
            subprocess.run(["fsfreeze", "-u", str(self.folder)], check=True)


@contextlib.contextmanager
def small_disk(parent: Path) -> Iterator[Disk]:
    """Mount a disk below a folder until the end of the context; raise `NoDisk`."""
    folder, image = parent / "disk", parent / "image"
    folder.mkdir()
    with image.open("wb") as file:
        file.truncate(IMAGE_BYTES)
    mount = ("mount", "-o", "loop,errors=remount-ro", str(image), str(folder))
    if call("mkfs.ext4", "-q", "-F", str(image)).returncode or call(*mount).returncode:
        raise NoDisk("no file system may be mounted here")
    assert folder.is_mount()
    try:
        yield Disk(folder)
    finally:
        call("umount", "--lazy", str(folder))
