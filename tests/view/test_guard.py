"""Who may use the page, and what it takes: other web pages are refused, and bad messages end their own connection alone, in one line."""

from __future__ import annotations

import dataclasses
import gc
import http.client
import logging
import os
import socket
import time
import urllib.request
from collections.abc import Iterator

import msgspec
import pytest
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from raytac.errors import BackendError, InputError
from raytac.view import server as server_module
from raytac.view.server import PageAddresses
from raytac.view.viewer import Viewer
from tests.view.page_client import PageClient
from tests.view.still import StillSession

UPGRADE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    "Sec-WebSocket-Version": "13",
}


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with Viewer(StillSession(), port=0, allow_hosts=("gpu3.example.org", "lab.example.org:9000")) as opened:
        yield opened


def answer(viewer: Viewer, host: str | None, origin: str | None = None, *, upgrade: bool = False) -> int:
    """Status of a request for the page, or for its websocket."""
    headers = {"Host": host, "Origin": origin} | (UPGRADE if upgrade else {})
    link = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=10.0)
    link.putrequest("GET", "/", skip_host=True)
    for name, value in headers.items():
        if value is not None:
            link.putheader(name, value)
    link.endheaders()
    try:
        return link.getresponse().status
    finally:
        link.close()


@pytest.mark.parametrize(
    "name", ["127.0.0.1:PORT", "localhost:PORT", "LOCALHOST:PORT", "[::1]:PORT", "gpu3.example.org:PORT", "lab.example.org:9000"]
)
def test_the_pages_own_addresses_are_answered(viewer, name):
    own = name.replace("PORT", str(viewer.port))
    assert answer(viewer, own) == 200
    assert answer(viewer, own, upgrade=True) == 101  # a program that is no browser sends no Origin
    assert answer(viewer, own, f"http://{own}", upgrade=True) == 101


def test_other_pages_may_not_show_this_one_in_a_frame(viewer):
    with urllib.request.urlopen(viewer.url) as page:
        assert page.headers["Content-Security-Policy"] == "frame-ancestors 'self'" and b"<html" in page.read()


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:PORT", "evil.example", "127.0.0.1", "127.0.0.1:1", "lab.example.org:PORT", "127.0.0.1.evil.example:PORT",
        "203.0.113.7:PORT", "", None,
    ],
)  # fmt: skip
def test_a_name_that_is_not_the_pages_is_refused_by_page_and_websocket(viewer, host):
    asked = host.replace("PORT", str(viewer.port)) if host else host
    for upgrade in (False, True):
        assert answer(viewer, asked, upgrade=upgrade) == 403
        assert answer(viewer, asked, f"http://{asked}", upgrade=upgrade) == 403, "DNS rebinding: both headers name the other page"


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "http://evil.example:PORT", "http://127.0.0.1:1", "http://127.0.0.1", "null", "", "http://localhost:PORT", "file://"],
)  # fmt: skip
def test_another_origin_is_refused(viewer, origin):
    own, asked = f"127.0.0.1:{viewer.port}", origin.replace("PORT", str(viewer.port))
    for upgrade in (False, True):
        assert answer(viewer, own, asked, upgrade=upgrade) == 403


def test_two_hosts_or_origins_are_refused():
    own = PageAddresses("127.0.0.1")
    at = ("127.0.0.1", 8080)
    assert own.refusal(["127.0.0.1:8080"], [], at) == ""
    assert own.refusal(["127.0.0.1:8080", "evil.example"], [], at)
    assert own.refusal(["127.0.0.1:8080"], ["http://127.0.0.1:8080", "http://evil.example"], at)


def test_the_default_ports_are_left_out_as_browsers_do():
    own = PageAddresses("0.0.0.0", ("view.example.org:443",))
    assert own.refusal(["127.0.0.1"], ["http://127.0.0.1"], ("127.0.0.1", 80)) == ""
    assert own.refusal(["view.example.org"], ["https://view.example.org"], ("127.0.0.1", 8080)) == ""
    assert own.refusal(["view.example.org"], ["https://evil.example"], ("127.0.0.1", 8080))


def test_the_address_that_was_reached_is_the_pages_own_and_a_name_is_not():
    own = PageAddresses("0.0.0.0")
    assert own.refusal(["192.0.2.5:8080"], ["http://192.0.2.5:8080"], ("192.0.2.5", 8080)) == ""
    assert own.refusal(["[2001:db8::1]:8080"], [], ("2001:db8:0::1", 8080)) == ""
    for host in ("192.0.2.6:8080", "gpu3.example.org:8080"):
        assert "--allow-host" in own.refusal([host], [], ("192.0.2.5", 8080))
    named = PageAddresses("Gpu3.example.org")
    assert named.refusal(["gpu3.example.org:8080"], [], ("192.0.2.5", 8080)) == ""
    assert own.url(("::1", 80)) == "http://[::1]:80"


@pytest.mark.parametrize(
    "name",
    ["", "*", "http://a.example", "a.example/x", "a b", "a.example:0", "a.example:65536", "a:b:c", "-a", ".a", "[::1", "a" * 64],
)
def test_a_name_that_cannot_be_allowed_is_said(name):
    with pytest.raises(InputError, match="allow_host = "):
        PageAddresses("127.0.0.1", (name,))
    for host, allowed in ((5, ()), ("127.0.0.1", "a.example"), ("127.0.0.1", (5,))):
        with pytest.raises(InputError, match="host"):
            PageAddresses(host, allowed)  # type: ignore[arg-type]
    PageAddresses("127.0.0.1", ("::1", "[::1]:9000", "a-b.example:9000", "192.0.2.1"))


def test_without_the_guard_nothing_is_served(monkeypatch):
    """viser may change: its own functions, not copies that see the guard, stand for such a version."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    monkeypatch.setattr(server_module, "_copied", lambda function, **names: function)
    with pytest.raises(BackendError, match="cannot be guarded"):
        Viewer(StillSession(), port=port)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=5.0)


def test_other_servers_of_viser_are_as_they_were(viewer):
    plain = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        linked = connect(f"ws://127.0.0.1:{plain.get_port()}", subprotocols=[PROTOCOL], origin="http://other.example")  # type: ignore[arg-type]
        linked.close()
    finally:
        plain.stop()


# --- messages ------------------------------------------------------------------------------------------------------------------

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


def encoded(**message: object) -> bytes:
    return msgspec.msgpack.encode(message)


def camera(**changes: object) -> bytes:
    fields: dict[str, object] = dict(
        type="ViewerCameraMessage", wxyz=(1, 0, 0, 0), position=(1, 1, 1), fov=0.7, near=0.01, far=100, image_height=300,
        image_width=400, look_at=(0, 0, 0), up_direction=(0, 0, 1),
    )  # fmt: skip
    return encoded(**{**fields, **changes})


GARBAGE = {
    "nothing": b"",
    "a number": b"\0",
    "noise": os.urandom(50),
    "a list": msgspec.msgpack.encode([]),
    "nil": msgspec.msgpack.encode(None),
    "an array that is not there": b"\xdd\xff\xff\xff\xff",
    "deep": b"\x91" * 50_000,
    "deep in a field": b"\x82\xa4type\xb0GuiUpdateMessage\xa7updates" + b"\x91" * 50_000,
    "cut short": camera()[:-3],
    "too long": bytes(server_module.LARGEST + 1),
    "text": "text",
    "a type that is not": encoded(type="Nope"),
    "a type that commands a terminal": encoded(type="\n\x1b[2J" + 1000 * "x"),
    "a field that commands a terminal": camera(**{"\n\x1b[2J": 1}),
    "no type": encoded(uuid="a"),
    "a number as type": encoded(type=5),
    "fields missing": encoded(type="GuiUpdateMessage"),
    "a tunnel to the world": encoded(type="ShareUrlRequest"),
    "an upload": encoded(
        type="FileTransferStartUpload", source_component_uuid="a", transfer_uuid="b", filename="c", mime_type="d", part_count=1,
        size_bytes=2,
    ),
    "what only the server sends": encoded(type="GuiRemoveMessage", uuid="a"),
    "a handle at nan": encoded(type="TransformControlsUpdateMessage", name="/handle", position=(float("nan"), 0, 0), wxyz=(1, 0, 0, 0)),
    "a handle without a turn": encoded(type="TransformControlsUpdateMessage", name="/handle", position=(0, 0, 0), wxyz=(0, 0, 0, 0)),
    "a handle of a long name": encoded(type="TransformControlsDragStartMessage", name="x" * 1000),
    "a picture that is none": encoded(type="GetRenderResponseMessage", payload=b"GIF89a", render_uuid="a"),
    "a picture that is too long": bytes(server_module.LARGEST_PICTURE + 1),
    "a long message that is no picture": encoded(type="GuiUpdateMessage", uuid="a", updates={"value": "x" * server_module.LARGEST}),
    "a camera at nan": camera(position=(float("nan"), 0, 0)),
    "a camera without view": camera(position=(0, 0, 0)),
    "a camera without up": camera(up_direction=(0, 0, 0)),
    "a camera far off": camera(look_at=(1e300, 0, 0)),
    "a flat camera": camera(wxyz=(1, 0, 0)),
}  # fmt: skip


class Stranger:
    """A connection that says what it likes."""

    def __init__(self, viewer: Viewer) -> None:
        self.link: ClientConnection = connect(f"ws://127.0.0.1:{viewer.port}", subprotocols=[PROTOCOL], max_size=None)

    def ends(self, message: bytes | str) -> int | None:
        """The code that the server hangs up with after ``message``."""
        self.link.send(message)
        end = time.monotonic() + 10.0
        with pytest.raises(ConnectionClosed) as caught:
            while time.monotonic() < end:
                self.link.recv(timeout=5.0)
        assert caught.value.rcvd is not None
        return caught.value.rcvd.code


@pytest.fixture
def witness(viewer: Viewer) -> Iterator[PageClient]:
    client = PageClient(viewer.port)
    client.until(lambda: "<table" in client.texts() and "paused" in client.texts(), "the first state")
    yield client
    before = client.texts()
    client.press("Step")
    client.until(lambda: client.texts() != before, "the others go on")
    client.press("Reset")
    client.until(lambda: "<td>at</td><td style='text-align:right'>0</td>" in client.texts())
    client.close()


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What a terminal shows."""
    gc.collect()  # asyncio tells of a task's exception when the task goes
    logged = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert not [record for record in logged if record.exc_info]
    return [record.getMessage() for record in logged]


def test_garbage_ends_its_own_connection_in_one_line(viewer, witness, caplog, capfd):
    for what, message in GARBAGE.items():
        assert Stranger(viewer).ends(message) == (1009 if "long" in what and "name" not in what else 1007), what
    logged = lines(caplog)
    assert len(logged) == len(GARBAGE) and all(
        "hung up on 127.0.0.1 port" in line and line.isprintable() and len(line) < 250 for line in logged
    )
    assert "Traceback" not in "".join(capfd.readouterr())


UPDATES = [
    *(("reach [mm]", {"value": value}) for value in ("x", None, [], {}, [1.0], float("nan"), 1e18, -1, 100.1, True, b"1")),
    *(("colour", {"value": value}) for value in ("no such", 1.0, True, None)),
    *(("Step", {"value": value}) for value in ("Stop", 0.0, None)),
    *(("see through", {"value": value}) for value in (1.0, "yes", None)),
    # nothing but the value can be set
    *(("reach [mm]", updates) for updates in ({"min": 5.0}, {"label": "x"}, {"update_cb": []}, {}, {"removed": True})),
    ("reach [mm]", {"value": 1.0, "step": 1.0}),
]  # fmt: skip


def test_what_an_element_cannot_have_ends_the_connection_and_changes_nothing(viewer, witness, caplog, capfd):
    before = {key: dict(element) for key, element in witness.elements.items()}
    for label, updates in UPDATES:
        message = encoded(type="GuiUpdateMessage", uuid=witness._find(label)[0], updates=updates)
        assert Stranger(viewer).ends(message) == 1007, (label, updates)
    assert len(lines(caplog)) == len(UPDATES)
    assert witness.elements == before and "Traceback" not in "".join(capfd.readouterr())


def test_what_an_element_can_have_is_taken_and_one_that_is_gone_does_no_harm(viewer, witness, caplog):
    stranger = Stranger(viewer)
    stranger.link.send(camera())
    stranger.link.send(encoded(type="GuiUpdateMessage", uuid="gone", updates={"value": 1.0}))
    stranger.link.send(encoded(type="GuiUpdateMessage", uuid=witness._find("reach [mm]")[0], updates={"value": 13}))
    witness.until(lambda: "13 cannot be reached" in witness.texts(), "the error on the page")
    stranger.link.close()
    assert lines(caplog) == []


def test_a_long_picture_is_taken_and_one_that_nobody_asked_for_does_no_harm(viewer, witness, caplog):
    stranger = Stranger(viewer)
    stranger.link.send(camera())
    long = b"\xff\xd8\xff" + bytes(server_module.LARGEST)
    stranger.link.send(encoded(type="GetRenderResponseMessage", payload=long, render_uuid="nobody's"))
    stranger.link.send(encoded(type="TransformControlsUpdateMessage", name="/other", position=(0, 0, 0), wxyz=(1, 0, 0, 0)))
    stranger.link.send(encoded(type="GuiUpdateMessage", uuid=witness._find("reach [mm]")[0], updates={"value": 13}))
    witness.until(lambda: "13 cannot be reached" in witness.texts(), "the connection goes on")
    stranger.link.close()
    assert lines(caplog) == []


def test_a_request_that_is_no_http_says_nothing(caplog, capfd):
    with Viewer(StillSession(), port=0) as fresh:  # viser hides such faults after its first request only
        socket.create_connection(("127.0.0.1", fresh.port), timeout=10.0).close()
        for raw in (
            b"GARBAGE\r\n\r\n",
            b"\x16\x03\x01" * 10 + b"\n",
            b"POST / HTTP/1.1\r\nHost: x\r\n\r\n",
            b"GET / HTTP/9.9\r\n\r\n",
        ):
            with socket.create_connection(("127.0.0.1", fresh.port), timeout=10.0) as link:
                link.sendall(raw)
                while link.recv(4096):
                    pass
        assert lines(caplog) == []
    assert "Traceback" not in "".join(capfd.readouterr())


def test_the_messages_are_visers_own():
    """Fails if viser's browser tells more of its camera, or says it in another form."""
    assert set(server_module._Camera.__struct_fields__) == {
        field.name for field in dataclasses.fields(_messages.ViewerCameraMessage)
    }
    assert set(server_module._Update.__struct_fields__) == {
        field.name for field in dataclasses.fields(_messages.GuiUpdateMessage)
    }
    for name in ("TransformControlsUpdate", "TransformControlsDragStart", "TransformControlsDragEnd", "GetRenderResponse"):
        own = next(
            kind
            for kind in vars(server_module).values()
            if getattr(kind, "__struct_config__", None) and kind.__struct_config__.tag == f"{name}Message"
        )
        assert set(own.__struct_fields__) == {field.name for field in dataclasses.fields(getattr(_messages, f"{name}Message"))}
    moved = encoded(
        type="TransformControlsUpdateMessage", name="/handle", position=(1.0, 2.0, 3.0), wxyz=(1.0, 0.0, 0.0, 0.0), owner=""
    )
    for raw in (camera(), encoded(type="GuiUpdateMessage", uuid="a", updates={"value": True}), moved):
        again = server_module.checked_message(raw, lambda uuid: None)
        assert _messages.Message.deserialize(again) == _messages.Message.deserialize(raw)


def test_what_viser_reads_is_what_was_checked():
    """A key that is there twice: whichever of the two is checked is the one that is passed on."""
    body = camera()[1:]
    twice = bytes([camera()[0] + 1]) + body + msgspec.msgpack.encode("type") + msgspec.msgpack.encode("ShareUrlRequest")
    try:
        again = server_module.checked_message(twice, lambda uuid: None)
    except server_module.BadMessage:
        return
    assert msgspec.msgpack.decode(again)["type"] == "ViewerCameraMessage"
