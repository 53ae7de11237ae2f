"""The page, by clients without a browser: what users do reaches the session, and every client sees what comes of it."""

from __future__ import annotations

import socket
import threading
import urllib.request
from typing import Any

import pytest

from raytac.errors import BackendError, InputError
from raytac.view import availability
from raytac.view.session import reaching
from raytac.view.viewer import Viewer
from tests.view.page_client import PageClient
from tests.view.still import LENGTH, StillSession


@pytest.fixture
def open_page():
    opened: list[Any] = []

    def make(session: StillSession) -> tuple[Viewer, PageClient]:
        viewer = Viewer(session, port=0)
        opened.append(viewer)
        client = PageClient(viewer.port)
        opened.append(client)
        client.until(lambda: "<table" in client.texts() and "paused" in client.texts(), "the first state")
        return viewer, client

    yield make
    for thing in reversed(opened):
        thing.close()


def at(client: PageClient, value: float) -> bool:
    return f"<td>at</td><td style='text-align:right'>{value:g}</td>" in client.texts()


def test_the_browser_gets_a_page_with_everything_on_it(open_page):
    viewer, client = open_page(StillSession())
    with urllib.request.urlopen(viewer.url) as answer:
        assert answer.status == 200 and b"<html" in answer.read()
    assert "still · nothing" in client.texts() and "F<sub>z</sub>" in client.texts()
    assert {"/solids/block", "/lines/axis", "/coats/left"} <= client.nodes.keys()
    assert client.nodes["/solids/block"]["opacity"] == pytest.approx(0.35)
    image = client.until(lambda: next(e for e in client.elements.values() if e.get("label") == "left"))
    assert image["visible"] and image["_data"] is not None


def test_play_pause_step_and_reset_move_the_session(open_page):
    viewer, client = open_page(StillSession())
    coat = client.nodes["/coats/left"]["glb_data"]
    client.press("Step")
    client.until(lambda: at(client, 1.0), "one step")
    assert client.nodes["/coats/left"]["glb_data"] != coat
    client.press("Play")
    client.until(lambda: at(client, LENGTH) and "paused" in client.texts(), "the end")
    assert client.value("reach [mm]") == LENGTH  # sliders follow what plays
    client.press("Reset")
    client.until(lambda: at(client, 0.0), "the start")
    assert viewer.player.status.count == 0


def test_a_slider_drives_and_the_other_clients_see_it(open_page):
    session = StillSession()
    viewer, first = open_page(session)
    second = PageClient(viewer.port)
    for k in range(60):
        first.set("reach [mm]", 0.1 * k)
    first.set("reach [mm]", 3.5)
    first.until(lambda: at(first, 3.5), "the target")
    second.until(lambda: at(second, 3.5) and second.value("reach [mm]") == 3.5, "the other client")
    assert first.value("push [N]") == pytest.approx(0.5)  # not held, so it shows what is (0.35, in steps of 0.5)
    assert len([call for call in session.calls if isinstance(call, dict)]) < 61
    second.set("push [N]", 2.0)
    first.until(lambda: at(first, 2.0), "the other client's target")
    second.close()


def test_a_slider_is_as_long_as_its_control_is_now(open_page):
    session = StillSession()
    _, client = open_page(session)
    slider = next(e for e in client.elements.values() if e.get("label") == "push [N]")
    assert slider["max"] == 10.0
    session.controls = reaching(session.controls, {"reach": -3.0, "push": 27.1})
    assert [(c.low, c.high) for c in session.controls] == [(-5.0, 100.0), (0.0, 50.0)]
    client.press("Step")
    client.until(lambda: slider["max"] == 50.0, "the longer slider")


def test_the_sign_of_a_force_is_explained_where_there_is_one(open_page):
    _, client = open_page(StillSession())
    signs = client.until(lambda: next((e for e in client.elements.values() if "z points out" in str(e.get("content"))), None))
    assert signs["visible"]


def test_an_error_is_shown_until_the_next_command(open_page):
    _, client = open_page(StillSession())
    client.set("reach [mm]", 13.0)
    client.until(lambda: "13 cannot be reached" in client.texts(), "the error")
    client.until(lambda: client.value("reach [mm]") == 0.0, "the slider goes back to what is so")
    client.press("Step")
    client.until(lambda: at(client, 1.0) and "13 cannot" not in client.texts(), "the error to go")


def test_what_is_shown_can_be_chosen(open_page):
    _, client = open_page(StillSession())
    client.press("Step")
    client.until(lambda: at(client, 1.0))
    client.set("colour", "normal traction [kPa]")
    client.until(lambda: "<div>normal traction [kPa]</div>" in client.texts(), "the legend")
    client.set("see through", False)
    client.until(lambda: client.nodes["/solids/block"]["opacity"] is None, "an opaque object")


def test_each_client_looks_where_it_likes(open_page):
    viewer, one = open_page(StillSession())
    two = PageClient(viewer.port)
    two.until(lambda: two.eye is not None, "the start")
    start = two.eye
    one.press("left")
    one.until(lambda: one.eye == pytest.approx((3.5, 6.0, 6.0)), "the pad, 100 units a metre")
    assert two.eye == start
    one.press("all")
    one.until(lambda: one.eye == pytest.approx((2.0, -3.0, 2.0)), "the start again")
    two.close()


def test_closing_tells_the_clients_frees_the_port_and_ends_all_threads():
    before = set(threading.enumerate())
    viewer = Viewer(StillSession(), port=0)
    client = PageClient(viewer.port)
    client.until(lambda: "paused" in client.texts())
    client.press("Play")
    viewer.close()
    viewer.close()
    client._reader.join(5.0)
    assert not client._reader.is_alive()  # the server has hung up
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", viewer.port))
    started = [t for t in threading.enumerate() if t not in before and not t.name.startswith("ThreadPoolExecutor")]
    for thread in started:
        thread.join(5.0)
    assert [t.name for t in started if t.is_alive()] == []


def test_two_viewers_share_nothing(open_page):
    first, one = open_page(StillSession())
    second, two = open_page(StillSession())
    assert first.port != second.port
    one.press("Step")
    one.until(lambda: at(one, 1.0))
    assert at(two, 0.0) and second.player.status.count == 0


def test_an_address_that_cannot_be_is_a_clear_error():
    for port in (-1, 65536, 80.5, True):
        with pytest.raises(InputError, match=r"port = .*\[0, 65535\]"):
            Viewer(StillSession(), port=port)  # type: ignore[arg-type]
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(InputError, match=r"port = .*in use"):
            Viewer(StillSession(), port=other.getsockname()[1])
    with pytest.raises(InputError, match=r"host = '203\.0\.113\.7'"):  # an address for examples, nobody's
        Viewer(StillSession(), host="203.0.113.7", port=0)


def test_without_viser_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr(availability.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BackendError, match=r"pip install 'raytac\[view\]'"):
        Viewer(StillSession(), port=0)
