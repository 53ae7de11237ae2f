"""``Viewer``: a web server, its page and the session's thread, from start to end."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from raytac.errors import InputError
from raytac.view.availability import check_viewer
from raytac.view.page import Page
from raytac.view.player import Player
from raytac.view.saving import Saver
from raytac.view.server import PageAddresses
from raytac.view.session import Session, SessionMenu

_PATIENCE = 10.0
"""Longest wait at the end for the state being computed [s]; its thread is a daemon."""


class Viewer:
    """Serves a session to any number of browsers.

    .. code-block:: python

        with Viewer(session, port=8080) as viewer:
            print(viewer.url)
            input("Enter ends")

    Whoever can reach the port can move the sliders, save files to ``folder`` and sees what is shown; ``host="127.0.0.1"`` lets in this
    machine only. Other web pages in a browser that can reach it are refused: see ``PageAddresses``.
    """

    def __init__(
        self,
        session: Session,
        *,
        menu: SessionMenu | None = None,
        folder: str | Path | None = "runs/view",
        host: str = "127.0.0.1",
        port: int = 8080,
        allow_hosts: Sequence[str] = (),
    ) -> None:
        """Start serving and compute the first state.

        Args:
            menu: drop-downs that exchange the session; None is none.
            folder: where the page's buttons save to, made with the first file; None leaves the buttons out.
            host: address to listen at; ``0.0.0.0`` is every network that the machine is in.
            port: in [0, 65535]; 0 lets the system choose.
            allow_hosts: names beside ``host`` that browsers may ask for, as of ``PageAddresses``.

        Raises:
            BackendError: viser is not installed, or cannot be guarded.
            InputError: a port that cannot be, is taken or is not allowed, or an address that is not this machine's; a name that is none.
        """
        check_viewer()
        check_address(host, port, allow_hosts)
        from raytac.view.server import guarded_server

        self._addresses = PageAddresses(host, allow_hosts)
        self._server = guarded_server(host, port, self._addresses)
        self.host, self.port = host, self._server.get_port()
        try:
            if port not in (0, self.port):  # taken since it was checked; viser then goes on to the next
                raise InputError("port", value=port, rule="is taken; choose another one, or 0 for any that is free")
            self._page = Page(self._server, session, menu=menu, saver=None if folder is None else Saver(folder))
            self.player = Player(session, self._page.show)
            self._page.attach(self.player)
            self.player.start()
        except BaseException:
            self._server.stop()
            raise
        self._is_open = True

    @property
    def url(self) -> str:
        """Address that opens the page on this machine."""
        return self._addresses.url(({"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host), self.port))

    def close(self) -> None:
        """End the thread and the server, and free the port; a second call does nothing."""
        if self._is_open:
            self._is_open = False
            self.player.close(_PATIENCE)
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def check_address(host: str, port: int, allow_hosts: Sequence[str] = ()) -> None:
    """Raise ``InputError`` for a host and port that cannot be used, and names that are none."""
    PageAddresses(host, allow_hosts)
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port <= 65535:
        raise InputError("port", value=port, rule="must be a whole number in [0, 65535]; 0 takes any that is free")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise InputError("host", value=host, rule=f"must be an address or name of this machine ({error.strerror})") from error
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just left is free
        try:
            probe.bind(address)
        except PermissionError as error:
            raise InputError("port", value=port, rule="is not allowed to this user; choose one from 1024 on") from error
        except OSError as error:
            name, value = ("host", host) if error.errno == 99 else ("port", port)
            raise InputError(name, value=value, rule=f"cannot be listened at: {error.strerror}; choose another one") from error
