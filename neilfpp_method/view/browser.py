"""Serve the page of the viewer with viser. Each browser gets a session of its own (`session`)."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping

import rich
import viser

from neilfpp_method.relight.sky import Sky
from neilfpp_method.view.session import Session, Shared
from neilfpp_method.view.subject import Subject

__all__ = ["Page", "open_page"]

BRAND = (43, 108, 130)
"""Colour of the controls, sRGB bytes."""


class _Local(viser.ViserServer):
    """A server without viser's tunnel to the internet, which any page in the browser could request.

    Captures are private.
    """

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Page:
    """The page that all browsers see.

    Args:
        server: a running server of viser.
        subject: the run; None if there is no checkpoint yet.
        skies: environment maps by name, which can be selected instead of the run's own light.
    """

    def __init__(self, server: viser.ViserServer, subject: Subject | None, skies: Mapping[str, Sky]) -> None:
        self.server, self.subject = server, subject
        self._shared = Shared(skies)
        self._sessions: dict[int, Session] = {}
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def show(self, subject: Subject) -> None:
        """Show another subject, such as a later checkpoint. Cameras do not move."""
        self.subject = subject
        for client in self.server.get_clients().values():
            self._connect(client)

    def stop(self) -> None:
        """Close all sessions and the port."""
        for session in list(self._sessions.values()):
            session.painter.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _connect(self, client: viser.ClientHandle) -> None:
        previous = self._sessions.pop(client.client_id, None)
        if previous is not None:
            previous.close()
        if self.subject is None:
            client.gui.reset()
            client.gui.add_markdown("Waiting for the first checkpoint.")
            return
        self._sessions[client.client_id] = Session(self._shared, self.subject, client, previous)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.painter.stop()


def open_page(subject: Subject | None, skies: Mapping[str, Sky], host: str, port: int, label: str) -> Page:
    """Serve the page. The port must be free (`address.check_address`)."""
    # viser prints a box with an address that is not the one to open.
    rich.get_console().quiet = True
    server = _Local(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(
        show_logo=False, show_share_button=False, brand_color=BRAND, control_width="medium"
    )
    return Page(server, subject, skies)
