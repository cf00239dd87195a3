"""The lock of an open file, which the system takes from a process that dies.

The package filelock does not tell who has a lock, which `cortado.files.folder_lock` reads in the file.
"""

import os
import sys

if sys.platform == "win32":
    import msvcrt

    BEYOND = 2**30
    """The byte that is locked, far behind what the file holds, which others may then read."""

    def lock(file: int) -> None:
        """Lock a file by its descriptor; raises `BlockingIOError` where another process has it."""
        os.lseek(file, BEYOND, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except OSError as error:  # of a kind that is the same for every reason
            raise BlockingIOError(*error.args) from error
        finally:
            os.lseek(file, 0, os.SEEK_SET)

else:
    import fcntl

    def lock(file: int) -> None:
        """Lock a file by its descriptor; raises `BlockingIOError` where another process has it."""
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
