"""Check the address at which the page is served."""

from __future__ import annotations

import ipaddress
import socket

from neilfpp_method.errors import UserError

__all__ = ["check_address", "is_local"]


def is_local(host: str) -> bool:
    """Whether an address can only be reached from this machine.

    >>> is_local("127.0.0.1"), is_local("localhost"), is_local("0.0.0.0")
    (True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_address(host: str, port: int, port_option: str = "--port") -> None:
    """Check that a page can be served at an address.

    Args:
        host: name or address of this machine.
        port: the port.
        port_option: the option of the command that sets the port, for error messages.

    Raises:
        UserError: the port is in use or invalid, or the address is not one of this machine.
    """
    if not 1 <= port <= 65535:
        raise UserError(f"{port_option} {port}: no such port", "give a number from 1024 to 65535")
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        with socket.socket(addresses[0][0], socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(addresses[0][4])
            probe.listen()
    # Python raises a UnicodeError for a name with an empty or too long part.
    except (socket.gaierror, UnicodeError) as error:
        raise UserError(
            f"--host {host}: no such address", "give an address of this machine, for example 127.0.0.1"
        ) from error
    except OSError as error:
        raise UserError(
            f"port {port} of {host}: {error.strerror}", f"choose another with {port_option}"
        ) from error
