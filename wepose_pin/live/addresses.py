"""Network addresses that a user gives: ``[HOST:]PORT``."""

from __future__ import annotations

import contextlib
import socket

from ..errors import BadOption

LOOPBACK = "127.0.0.1"


def parse_address(text: str, option: str, example_port: int) -> tuple[str, int]:
    """Host and port of ``PORT``, of this machine, or ``HOST:PORT``; raises `BadOption` for anything else."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise BadOption(
            f"{option} {text}: a port or HOST:PORT is needed, as {example_port} or 192.168.1.20:{example_port}"
        )
    return host.removeprefix("[").removesuffix("]") or LOOPBACK, int(port)


def name_host(host: str) -> str:
    """The address under which others reach `host`, as a URL has it; of "any address" that of this machine's network."""
    if host in ("0.0.0.0", "::"):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
            probe.connect(("2001:db8::1" if ":" in host else "192.0.2.1", 9))  # sends nothing
            host = str(probe.getsockname()[0])
    return f"[{host}]" if ":" in host else host
