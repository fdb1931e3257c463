"""The addresses that a process listens on, as Linux's /proc has them."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

NO_PROC = not Path("/proc/self/net/tcp").exists() or sys.byteorder != "little"


def list_listening(pid: int) -> set[str]:
    """Addresses that a process listens on, TCP and UDP, as /proc has them."""
    inodes = set()
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = os.readlink(entry)
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    sockets = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            columns = line.split()
            if columns[9] in inodes and (table.startswith("udp") or columns[3] == "0A"):
                address = bytes.fromhex(columns[1].split(":")[0])
                words = [address[k : k + 4][::-1] for k in range(0, len(address), 4)]  # of this machine's byte order
                family = socket.AF_INET6 if table.endswith("6") else socket.AF_INET
                sockets.add(socket.inet_ntop(family, b"".join(words)))
    return sockets
