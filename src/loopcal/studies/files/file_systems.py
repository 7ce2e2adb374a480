# SPDX-License-Identifier: Apache-2.0
"""On which file system a folder is: SQLite's write-ahead log needs memory that all its users share,
which network file systems do not have.
"""

from __future__ import annotations

import re
import struct
import sys
from pathlib import Path

MOUNTS = Path("/proc/self/mountinfo")
"""Where Linux lists what is mounted."""

NETWORK = (
    *("9p", "acfs", "afpfs", "afs", "beegfs", "ceph", "cephfs", "cifs", "coda", "davfs", "fhgfs"),
    *("ftp", "gfs", "gfs2", "glusterfs", "gpfs", "lustre", "macfuse", "mmfs", "ncpfs", "nfs"),
    *("nfs3", "nfs4", "ocfs2", "orangefs", "osxfuse", "panfs", "pvfs2", "quobyte", "smb3", "smbfs"),
    *("vboxsf", "virtiofs", "wekafs", "webdav"),
)
"""Types of network and cluster file systems, of folders that a virtual machine shares, and of user
programs on macOS, most of which reach a network.
"""

NETWORK_IN_USER_SPACE = re.compile(
    r"fuse\.(?!ext|ntfs|exfat|overlay|fuse-overlayfs|bindfs|portal|gvfsd|lxcfs|gocryptfs|encfs)"
)
"""File systems of user programs, but for those that are known to use a local disk."""

STATFS = struct.Struct("=Ii5Q2iIIII16s")
"""Beginning of a `statfs` of macOS: sizes and counts, number, owner, type, flags, subtype, name."""

SIZE_OF_STATFS = 4096
"""Bytes that it has at most."""

LOCAL = 0x1000
"""Flag of a local file system (MNT_LOCAL)."""

_OCTAL = re.compile(r"\\([0-7]{3})")


def find_network_file_system(folder: Path) -> str | None:
    """Return the type of the network file system that a folder is on, such as `nfs4`.

    None where it is on a local disk, or where the system does not say it. Of a folder that does not
    exist, the place where it would be made counts.
    """
    path = folder.resolve()
    if sys.platform == "win32":
        return _find_network_drive(path)
    if sys.platform == "darwin":
        return _find_network_of_macos(path)
    if not MOUNTS.exists():
        return None
    kind = find_type(MOUNTS.read_text("utf-8", errors="surrogateescape"), path)
    return kind if is_network(kind) else None


def is_network(kind: str) -> bool:
    """Return whether a type of file system is one of a network."""
    return kind in NETWORK or NETWORK_IN_USER_SPACE.match(kind) is not None


def find_type(mounts: str, path: Path) -> str:
    """Return the type of the file system of an absolute path; empty where there is none.

    Parameters
    ----------
    mounts : text of the form of /proc/self/mountinfo; the last one of equal mounts counts.

    Examples
    --------
    >>> disk = "1 0 8:1 / / rw - ext4 /dev/a rw"
    >>> server = "2 1 0:40 / /srv rw shared:1 - nfs4 host:/b rw"
    >>> mounts = chr(10).join([disk, server])
    >>> find_type(mounts, Path("/srv/user/study")), find_type(mounts, Path("/tmp"))
    ('nfs4', 'ext4')
    """
    kind, depth = "", -1
    for line in mounts.splitlines():
        before, _, after = line.partition(" - ")
        place = Path(_OCTAL.sub(lambda match: chr(int(match[1], 8)), before.split(" ")[4]))
        if path.is_relative_to(place) and len(place.parts) >= depth:
            kind, depth = after.split(" ")[0], len(place.parts)
    return kind


def parse_statfs(content: bytes) -> tuple[str, bool]:
    """Return the type of a file system, and whether it is a local one, of a `statfs` of macOS."""
    *_, flags, _, name = STATFS.unpack_from(content)
    return name.partition(b"\0")[0].decode("ascii", "replace"), bool(flags & LOCAL)


def _find_network_of_macos(path: Path) -> str | None:
    """Return the type of the file system of a path of macOS where it is one of a network."""
    import ctypes

    while not path.exists() and path != path.parent:
        path = path.parent
    library = ctypes.CDLL(None)
    # the processors of Intel have an older function of the same name
    function = getattr(library, "statfs$INODE64", None) or library.statfs
    buffer = ctypes.create_string_buffer(SIZE_OF_STATFS)
    if function(str(path).encode(sys.getfilesystemencoding(), "surrogateescape"), buffer) != 0:
        return None
    kind, is_local = parse_statfs(buffer.raw)
    return kind if is_network(kind) or not is_local else None


def _find_network_drive(path: Path) -> str | None:
    """Return "network drive" for a path of Windows on one."""
    import ctypes

    remote = 4  # DRIVE_REMOTE
    kind = ctypes.windll.kernel32.GetDriveTypeW(path.anchor)  # type: ignore[attr-defined]
    return "network drive" if kind == remote or path.anchor.startswith("\\\\") else None
