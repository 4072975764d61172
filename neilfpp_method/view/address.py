"""Where the page is served: a port that is free, and a word about who can see it."""

from __future__ import annotations

import ipaddress
import socket

from neilfpp_method.errors import UserError

__all__ = ["check_free", "only_here"]


def only_here(host: str) -> bool:
    """Whether an address can be reached from this machine alone.

    >>> only_here("127.0.0.1"), only_here("localhost"), only_here("0.0.0.0")
    (True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_free(host: str, port: int) -> None:
    """That a page can be served there.

    Raises:
        UserError: the port is taken or none, or the address is not one of this machine.
    """
    if not 1 <= port <= 65535:
        raise UserError(f"--port {port}: no such port", "give a number from 1024 to 65535")
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(found[0][0], socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(found[0][4])
            probe.listen()
    except socket.gaierror as error:
        raise UserError(
            f"--host {host}: no such address", "give an address of this machine, as 127.0.0.1"
        ) from error
    except OSError as error:
        raise UserError(f"port {port} of {host}: {error.strerror}", "choose another with --port") from error
