"""An exclusive lock on a file: the file system's, or a marker file if that has no locks."""

import contextlib
import errno
import os
import socket
from collections.abc import Iterator
from pathlib import Path

# What flock answers where a file system has no locks: NFS without its lock service, Lustre mounted
# without them, file systems in user space, some containers.
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EBADF)

_ATTEMPT_S = 0.3  # s; the first look at a dead process's marker may only remove it


class Held(Exception):
    """Another process has the lock; the message names it and a remedy."""


@contextlib.contextmanager
def hold(path: Path, waits: bool = False) -> Iterator[bool]:
    """Holds the lock of the file `path`.

    The system lets go of a file's lock however its process ends. A marker of a process that was
    killed is replaced if that process ran on this machine; one of another machine has to be
    removed by hand, which `Held` says.

    Args:
      path: created if missing, and kept. A file next to it has the name of the holder.
      waits: until another process lets go of it, instead of raising `Held`.

    Yields:
      whether the lock is the system's, not a marker.

    Raises:
      Held: another process has it.
      OSError: the file cannot be written, or neither kind of lock works there.
    """
    # Imported here: `--help` need not pay for it.
    import filelock

    marker, note = path.with_name(f"{path.name}-marker"), path.with_name(f"{path.name}-holder")
    try:
        lock = filelock.FileLock(path, blocking=waits, fallback_to_soft=False)
        lock.acquire()
        is_systems = True
    except filelock.Timeout:
        raise Held(_holder(note)) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        lock = filelock.SoftFileLock(marker, timeout=-1 if waits else _ATTEMPT_S)
        try:
            lock.acquire()
        except filelock.Timeout:
            raise Held(f"{_holder(note)} (if it no longer runs, remove {marker})") from None
        is_systems = False
    try:
        note.write_text(f"process {os.getpid()} on {socket.gethostname()}")
        yield is_systems
    finally:
        note.unlink(missing_ok=True)
        lock.release()


def _holder(note: Path) -> str:
    try:
        return note.read_text().strip() or "another process"
    except OSError:  # it has just begun, or ended
        return "another process"
