"""viser's server behind a guard, which refuses other pages and checks messages."""

from __future__ import annotations

import http
import ipaddress
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import dist, hypot, isfinite
from types import FunctionType, ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any

from raytac.errors import BackendError, InputError
from raytac.view.availability import NOT_INSTALLED

try:
    import msgspec
    import websockets.asyncio.server
    from websockets.asyncio.server import ServerConnection
    from websockets.exceptions import ConnectionClosed
    from websockets.frames import CloseCode
    from websockets.http11 import Request, Response
except ModuleNotFoundError as error:
    raise BackendError(NOT_INSTALLED) from error

if TYPE_CHECKING:
    from viser import ViserServer

_LOG = logging.getLogger("raytac.view")
_SOCKETS = logging.getLogger("raytac.view.sockets")
"""Of websockets, whose lines about every connection are of no use to who looks at a scene."""
_SOCKETS.setLevel(logging.WARNING)
_FAULTS = (CloseCode.PROTOCOL_ERROR, CloseCode.INVALID_DATA, CloseCode.MESSAGE_TOO_BIG)
"""Why websockets itself ends a connection whose other end breaks the protocol."""


def guarded_server(host: str, port: int, addresses: PageAddresses) -> ViserServer:
    """A server of viser that answers only what ``addresses`` lets in.

    viser 1.1 has no argument for the two places of websockets' ``serve`` where requests are refused (``process_request``) and messages
    are read (``create_connection``). So the two functions of viser that lead there run here as copies in which that one name means
    something else; viser's own modules stay as they are, and so do other servers in this process.

    Raises ``BackendError``: viser has changed so that the guard is not reached; nothing is served then.
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
            "max_size": LARGEST_PICTURE,
            "logger": _SOCKETS,
        }
        return websockets.asyncio.server.serve(*args, **{**options, **guards})

    try:
        sockets = _overlaid(websockets.asyncio.server, serve=serve)
        names = _overlaid(websockets, asyncio=_overlaid(websockets.asyncio, server=sockets))

        class Sockets(infra.WebsockServer):
            _background_worker = _copied(_infra.WebsockServer._background_worker, websockets=names)

        class Server(viser.ViserServer):
            __init__ = _copied(viser.ViserServer.__init__, infra=_overlaid(infra, WebsockServer=Sockets))  # type: ignore[assignment]

            def stop(self) -> None:
                with _unprinted():
                    super().stop()

        with _unprinted():
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


@contextmanager
def _unprinted() -> Iterator[None]:
    """Without what viser prints of itself; ``raytac view`` prints the address that is allowed."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def _copied(function: Any, **names: Any) -> Any:
    """``function`` with other meanings of some names of its module, for this copy alone."""
    space = {**function.__globals__, **names}
    copy = FunctionType(function.__code__, space, function.__name__, function.__defaults__, function.__closure__)
    copy.__kwdefaults__ = function.__kwdefaults__
    return copy


def _overlaid(module: ModuleType, **names: Any) -> SimpleNamespace:
    """Contents of a module with some names replaced."""
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
                _LOG.warning("viewer: hung up on %s, which sent a bad message: %s", _who(self), error)
                await self.close(error.code, "bad message")
                assert self.protocol.close_exc is not None
                raise self.protocol.close_exc from error
            except ConnectionClosed as error:
                if error.sent is not None and error.sent.code in _FAULTS and not error.rcvd_then_sent:
                    _LOG.warning("viewer: hung up on %s: %s", _who(self), error.sent.reason)
                raise

    return Checked


def _who(connection: ServerConnection) -> str:
    address = connection.remote_address  # None of one that is gone again
    return f"{address[0]} port {address[1]}" if address else "a browser"


class _OneLine(logging.Filter):
    """Logs faults of a connection in one line. Connections that browsers open ahead are none."""

    def filter(self, record: logging.LogRecord) -> bool:
        if record.msg == "opening handshake failed":
            return False
        error = record.exc_info[1] if record.exc_info else None
        if error is not None:
            record.msg, record.args = f"viewer: {record.getMessage()}: {type(error).__name__}: {one_line(str(error))}", ()
            record.exc_info = record.exc_text = None
        return True


_SOCKETS.addFilter(_OneLine())


LARGEST = 2**16
"""Longest message that is taken [bytes], but for pictures; a camera takes 300."""
LARGEST_PICTURE = 2**21
"""Longest message with a picture of the 3-D view, which the page has asked for [bytes]."""
_Number = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
"""Of a camera; not NaN. The 3-D view is some units large, whatever it shows."""
_Vector = tuple[_Number, _Number, _Number]


class BadMessage(ValueError):
    """A message that no browser with this page sends."""

    def __init__(self, text: str, code: CloseCode = CloseCode.INVALID_DATA) -> None:
        """``code``: what the connection is ended with."""
        super().__init__(text)
        self.code = code


class _Camera(msgspec.Struct, tag="ViewerCameraMessage", forbid_unknown_fields=True):
    """Fields as of viser's message of that name."""

    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: Annotated[float, msgspec.Meta(ge=0, le=1e6)]
    image_width: Annotated[float, msgspec.Meta(ge=0, le=1e6)]
    look_at: _Vector
    up_direction: _Vector

    def __post_init__(self) -> None:
        if dist(self.position, self.look_at) < 1e-6 or hypot(*self.up_direction) < 1e-6:
            raise ValueError("a camera must look somewhere and have an up direction")


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """The only property of an element that a user sets; viser would let a browser set any."""

    value: bool | float | str


class _Update(msgspec.Struct, tag="GuiUpdateMessage", forbid_unknown_fields=True):
    uuid: str
    updates: _Value


_Name = Annotated[str, msgspec.Meta(max_length=100)]


class _Drag(msgspec.Struct, tag="TransformControlsUpdateMessage", forbid_unknown_fields=True):
    """Pose that a user has given to the handle of the 3-D view."""

    name: _Name
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    owner: _Name = ""

    def __post_init__(self) -> None:
        if not 0.99 < hypot(*self.wxyz) < 1.01:
            raise ValueError("a rotation must be a unit quaternion")


class _DragStart(msgspec.Struct, tag="TransformControlsDragStartMessage", forbid_unknown_fields=True):
    name: _Name
    owner: _Name = ""


class _DragEnd(msgspec.Struct, tag="TransformControlsDragEndMessage", forbid_unknown_fields=True):
    name: _Name
    owner: _Name = ""


class _Rendered(msgspec.Struct, tag="GetRenderResponseMessage", forbid_unknown_fields=True):
    """A picture that the page has asked for; viser drops one of an unknown ``render_uuid``."""

    payload: bytes
    render_uuid: _Name

    def __post_init__(self) -> None:
        if not self.payload.startswith(b"\xff\xd8\xff"):
            raise ValueError("a picture must be a JPEG")


_DECODER = msgspec.msgpack.Decoder(_Camera | _Update | _Drag | _DragStart | _DragEnd | _Rendered)


def checked_message(raw: bytes | str, element: Callable[[str], Any]) -> bytes:
    """The same message encoded again, from nothing but what was understood of it.

    Args:
        element: the element of a uuid, with its ``value``, and ``options`` or ``min`` and ``max`` if these say what it can be; None if
            there is none (any more), which viser does not mind.

    Raises:
        BadMessage: no MessagePack, of another type, or not what its type or its element takes.
    """
    if isinstance(raw, str):
        raise BadMessage("text instead of MessagePack")
    try:
        message = _DECODER.decode(raw)
    except msgspec.DecodeError as error:
        code = CloseCode.MESSAGE_TOO_BIG if len(raw) > LARGEST else CloseCode.INVALID_DATA
        raise BadMessage(one_line(str(error)), code) from error
    if len(raw) > LARGEST and not isinstance(message, _Rendered):
        raise BadMessage(f"{len(raw)} bytes, {LARGEST} at most", CloseCode.MESSAGE_TOO_BIG)
    if isinstance(message, _Update):
        target, value = element(message.uuid), message.updates.value
        if target is not None and not _fits(target, value):
            raise BadMessage(f"{str(value)[:40]!r} is no value of this element")
    return msgspec.msgpack.encode(message)


def one_line(text: str) -> str:
    """Start of a text that may quote anything, without what commands a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:120])


def _fits(target: Any, value: bool | float | str) -> bool:
    options = getattr(target, "options", None)
    if options is not None:
        return value in options
    if isinstance(target.value, bool) or isinstance(value, bool):
        return isinstance(target.value, bool) and isinstance(value, bool)
    if isinstance(target.value, str) or isinstance(value, str) or not isfinite(value):
        return False
    low, high = getattr(target, "min", value), getattr(target, "max", value)
    slack = 1e-6 * (high - low)  # a slider's value is a sum of steps
    return low - slack <= value <= high + slack


_LOCAL = ("127.0.0.1", "localhost", "[::1]")
_NAME = re.compile(r"(?!-)[a-z0-9_-]{1,63}(?<!-)(\.(?!-)[a-z0-9_-]{1,63}(?<!-))*", re.ASCII)
_DEFAULT_PORTS = (80, 443)
"""Browsers leave these out of an address."""


class PageAddresses:
    """Names and ports under which browsers may reach the page.

    Any web page that a user opens may send requests to this machine. In the header ``Origin`` a browser names the page that a request
    comes from, in ``Host`` the name that it asked for. The first shows another page; the second shows a foreign name whose owner has let
    it point to this machine (DNS rebinding).
    """

    def __init__(self, host: str, allow_hosts: Sequence[str] = ()) -> None:
        """Names for this machine, ``host``, and what is allowed beside.

        Args:
            host: address that is listened at.
            allow_hosts: further names, as ``NAME`` or ``NAME:PORT`` (the port that the browser sees, where something forwards it); an
                IPv6 address with a port stands in brackets.

        Raises:
            InputError: one that is no host name or address.
        """
        for name, value in (("host", host), *(("allow_host", value) for value in allow_hosts)):
            if not isinstance(value, str):
                raise InputError(name, value=value, rule="must be text")
        if isinstance(allow_hosts, str):
            raise InputError("allow_hosts", value=allow_hosts, rule="must be a list of names")
        self._pairs: set[tuple[str, int | None]] = {(name, None) for name in (*_LOCAL, _bracketed(host.lower()))}
        """Name and port; None is the port that is listened at."""
        self._pairs |= {_split(text) for text in allow_hosts}

    def refusal(self, hosts: Sequence[str], origins: Sequence[str], served_at: tuple[str, int]) -> str:
        """Why a request is refused; empty if it is for this page, and from it.

        Args:
            hosts: all values of the request's header ``Host``.
            origins: those of ``Origin``; a program that is no browser, and a browser that opens the page, send none.
            served_at: address and port of this machine that the request came in at. The address itself is one of the page's own, since
                no name was looked up to find it.
        """
        if len(hosts) != 1 or hosts[0].lower() not in self._own(served_at):
            return f"Host {', '.join(hosts)!r} is not an address of this page; open {self.url(served_at)}, or allow it by --allow-host"
        own = hosts[0].lower()
        if origins and (len(origins) != 1 or origins[0].lower() not in (f"http://{own}", f"https://{own}")):
            return f"Origin {', '.join(origins)!r} is another page"
        return ""

    def url(self, served_at: tuple[str, int]) -> str:
        """Address that opens the page."""
        return f"http://{_bracketed(served_at[0])}:{served_at[1]}"

    def _own(self, served_at: tuple[str, int]) -> set[str]:
        """Every value of ``Host`` that is this page's."""
        pairs = {(name, port or served_at[1]) for name, port in (*self._pairs, (_bracketed(served_at[0]), None))}
        return {f"{name}:{port}" for name, port in pairs} | {name for name, port in pairs if port in _DEFAULT_PORTS}


def _split(text: str) -> tuple[str, int | None]:
    """Name and port of ``NAME`` or ``NAME:PORT``, as browsers write them."""
    whole = _bracketed(text.strip().lower())  # the end of a bare IPv6 address is no port
    match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[^\[\]:]+)(?::([0-9]{1,5}))?", whole)
    name = _bracketed(match[1].strip("[]")) if match else ""
    port = int(match[2]) if match and match[2] else None
    if not (name.startswith("[") or _NAME.fullmatch(name)) or port == 0 or (port or 0) > 65535:
        rule = "must be a host name or address, as in gpu3.example.org or gpu3.example.org:9000, without http:// and path"
        raise InputError("allow_host", value=text, rule=rule)
    return name, port


def _bracketed(name: str) -> str:
    """An IPv6 address as it stands in a URL; anything else as it is."""
    try:
        return f"[{ipaddress.IPv6Address(name).compressed}]"
    except ValueError:
        return name
