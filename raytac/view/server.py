"""viser's server with a guard before it: requests of other pages are refused, and messages are checked before viser sees them."""

from __future__ import annotations

import http
import logging
from collections.abc import Callable
from types import FunctionType, ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from raytac.errors import BackendError
from raytac.view.addresses import PageAddresses
from raytac.view.messages import LARGEST, BadMessage, checked_message, one_line

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["guarded_server"]

_LOG = logging.getLogger("raytac.view")
_FAULTS = (CloseCode.PROTOCOL_ERROR, CloseCode.INVALID_DATA, CloseCode.MESSAGE_TOO_BIG)
"""Why websockets itself ends a connection whose other end breaks the protocol."""


def guarded_server(host: str, port: int, addresses: PageAddresses) -> ViserServer:
    """A server of viser that answers only what ``addresses`` lets in.

    viser 1.1 has no argument for the two places of websockets' ``serve`` where requests are refused (``process_request``) and messages
    are read (``create_connection``). So the two functions of viser that lead there run here as copies in which that one name means
    something else; viser's own modules stay as they are, and so do other servers in this process.

    Raises:
        BackendError: viser has changed so that the guard is not reached; nothing is served then.
    """
    import viser
    from viser import infra
    from viser.infra import _infra

    guarded: list[bool] = []
    elements: dict[str, Any] = {}

    def serve(*args: Any, process_request: Callable[..., Any] | None = None, **options: Any) -> Any:
        guarded.append(True)
        guards = {
            "process_request": _refuse_others(addresses, process_request),
            "create_connection": _checked_connection(lambda uuid: elements.get(uuid)),
            "max_size": LARGEST,
            "logger": _LOG,
        }
        return websockets.asyncio.server.serve(*args, **{**options, **guards})

    try:
        sockets = _overlaid(websockets.asyncio.server, serve=serve)
        names = _overlaid(websockets, asyncio=_overlaid(websockets.asyncio, server=sockets))

        class Sockets(infra.WebsockServer):
            _background_worker = _copied(_infra.WebsockServer._background_worker, websockets=names)

        class Server(viser.ViserServer):
            __init__ = _copied(viser.ViserServer.__init__, infra=_overlaid(infra, WebsockServer=Sockets))  # type: ignore[assignment]

        server = Server(host, port, verbose=False)
    except AttributeError as error:
        raise BackendError(f"{_CHANGED} ({error})") from error
    known = getattr(server.gui, "_gui_input_handle_from_uuid", None)
    if not guarded or known is None:
        server.stop()
        raise BackendError(_CHANGED)
    elements = known
    return server


_CHANGED = "this version of viser cannot be guarded against other web pages: `pip install 'viser==1.1.1'`"


def _copied(function: Any, **names: Any) -> Any:
    """``function`` with other meanings of some names of its module, for this copy alone."""
    space = {**function.__globals__, **names}
    copy = FunctionType(function.__code__, space, function.__name__, function.__defaults__, function.__closure__)
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _overlaid(module: ModuleType, **names: Any) -> SimpleNamespace:
    """What a module holds, with some names changed."""
    return SimpleNamespace(**{**vars(module), **names})


def _refuse_others(addresses: PageAddresses, serve_files: Callable[..., Any] | None) -> Callable[..., Any]:
    """A ``process_request``: 403 for what is not from the page, else what viser answers."""

    def process(connection: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        reason = addresses.refusal(headers.get_all("Host"), headers.get_all("Origin"), connection.local_address[:2])
        if reason:
            _LOG.info("refused %s: %s", _who(connection), reason)
            return connection.respond(http.HTTPStatus.FORBIDDEN, f"raytac view: {reason}.\n")
        response = serve_files(connection, request) if serve_files is not None else None
        if response is not None:  # no other page may show this one in a frame and have users click on it unawares
            response.headers["Content-Security-Policy"] = "frame-ancestors 'self'"
        return response

    return process


def _checked_connection(element: Callable[[str], Any]) -> type[ServerConnection]:
    """A ``create_connection``: hangs up on whoever sends what the page does not."""

    class Checked(ServerConnection):
        async def recv(self, decode: bool | None = None) -> Any:
            try:
                return checked_message(await super().recv(decode), element)
            except BadMessage as error:
                _LOG.warning("raytac: viewer: hung up on %s, which sent a bad message: %s", _who(self), error)
                await self.close(CloseCode.INVALID_DATA, "bad message")
                assert self.protocol.close_exc is not None
                raise self.protocol.close_exc from error
            except ConnectionClosed as error:
                if error.sent is not None and error.sent.code in _FAULTS and not error.rcvd_then_sent:
                    _LOG.warning("raytac: viewer: hung up on %s: %s", _who(self), error.sent.reason)
                raise

    return Checked


def _who(connection: ServerConnection) -> str:
    address = connection.remote_address  # None of one that is gone again
    return f"{address[0]} port {address[1]}" if address else "a browser"


class _OneLine(logging.Filter):
    """Logs faults of a connection in one line, without a traceback; a request that is no HTTP, or never comes, not at all.

    Browsers open connections ahead that they then do not use.
    """

    def filter(self, record: logging.LogRecord) -> bool:
        if record.msg == "opening handshake failed":
            return False
        error = record.exc_info[1] if record.exc_info else None
        if error is not None:
            record.msg, record.args = f"raytac: viewer: {record.getMessage()}: {type(error).__name__}: {one_line(str(error))}", ()
            record.exc_info = record.exc_text = None
        return True


_LOG.addFilter(_OneLine())
