"""The page, by clients without a browser: what users do reaches the session, and every client sees what comes of it."""

from __future__ import annotations

import socket
import threading
import urllib.request
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from raytac.errors import BackendError, InputError, RaytacError
from raytac.view import availability
from raytac.view.recording import read_recording
from raytac.view.session import Control, Pad, SessionMenu, Snapshot, reaching
from raytac.view.viewer import Viewer
from tests.view.page_client import PageClient
from tests.view.still import LENGTH, StillSession


@pytest.fixture
def open_page():
    opened: list[Any] = []

    def make(session: StillSession, **options: Any) -> tuple[Viewer, PageClient]:
        viewer = Viewer(session, port=0, **options)
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


def test_the_handle_moves_what_the_sliders_move_and_stops_at_their_ends(open_page):
    session = StillSession()
    _, client = open_page(session)
    still = (1.0, 0.0, 0.0, 0.0)
    node = client.until(lambda: client.nodes.get("/handle"))
    client.drag("Start")
    client.drag("Update", position=(0.35, 0.0, 0.0), wxyz=still)  # 3.5 mm, at 100 units a metre
    client.until(lambda: at(client, 3.5) and client.value("reach [mm]") == 3.5, "the slider follows the handle")
    assert all("push" not in call for call in session.calls if isinstance(call, dict))  # what did not move is not asked for
    client.drag("Update", position=(0.35, 0.0, -4.0), wxyz=still)  # 40 mm down, 30 beyond the end
    client.until(lambda: client.value("push [N]") == 10.0 and at(client, 10.0), "the end")
    client.drag("End")
    client.until(lambda: node.get("position") == pytest.approx((1.0, 0.0, -0.1)), "the handle where the object is")
    client.set("reach [mm]", 4.0)
    client.until(lambda: node.get("position") == pytest.approx((0.4, 0.0, -0.04)), "the handle follows the slider")
    client.set("handle", False)
    client.until(lambda: node.get("visible") is False or not node.get("visible", True), "no handle")


def test_one_looks_back_on_the_timeline_and_goes_on_from_the_present(open_page):
    session = StillSession()
    _, client = open_page(session)
    client.press("Play")
    client.until(lambda: at(client, LENGTH) and "paused" in client.texts(), "the end")
    assert client.value("timeline") == LENGTH
    client.set("timeline", 2.0)
    client.until(lambda: at(client, 2.0) and "state 3 of 6" in client.texts(), "the past")
    assert client.value("reach [mm]") == 2.0 and session.at == LENGTH
    client.set("colour", "normal traction [kPa]")
    client.until(lambda: "<div>normal traction [kPa]</div>" in client.texts() and at(client, 2.0), "the past in other colours")
    client.set("reach [mm]", 4.5)
    client.until(lambda: at(client, 4.5) and "looking back" not in client.texts(), "the present")
    plot = next(e for e in client.elements.values() if e.get("title") == "left: force [N]")
    assert plot["visible"] and len(client.until(lambda: plot["data"])) == 4
    client.press("Reset")
    client.until(lambda: at(client, 0.0) and not client.element("timeline")["visible"], "a timeline of its own")


class Other(StillSession):
    title = "other · nothing"
    controls = (Control("lift", "lift [mm]", 0.0, 5.0, 0.5),)
    handle = None
    pads = (Pad("right", np.array([[0, 1, 2]])),)

    def snapshot(self) -> Snapshot:
        shown = super().snapshot()
        return replace(shown, pads={"right": shown.pads["left"]}, controls={"lift": self.at}, handle=None)


def test_another_session_is_chosen_in_the_page_and_what_cannot_work_changes_nothing(open_page):
    def made(choice):
        if choice["object"] == "bad":
            raise RaytacError("bad: it has no object")
        return {"still": StillSession, "other": Other}[choice["object"]]()

    options = {"object": ("still", "other", "bad"), "sensor": ("mini", "dome")}
    menu = SessionMenu(options, {"object": "still", "sensor": "mini"}, made)
    viewer, client = open_page(StillSession(), menu=menu)
    client.press("Step")
    client.until(lambda: at(client, 1.0))
    client.set("object", "bad")
    client.until(lambda: "it has no object" in client.texts(), "the error")
    client.until(lambda: client.value("object") == "still" and at(client, 1.0), "the present state")
    client.press("Step")
    client.until(lambda: at(client, 2.0) and "it has no object" not in client.texts(), "it goes on")
    client.set("object", "other")
    client.until(lambda: "other · nothing" in client.texts() and at(client, 0.0), "the other session")
    client.set("lift [mm]", 2.0)
    client.until(lambda: at(client, 2.0), "its own slider")
    live = client.labels()
    assert "reach [mm]" not in live and "left" not in live and "right" in live and "/handle" not in client.nodes
    late = PageClient(viewer.port)
    late.until(lambda: "other · nothing" in late.texts() and at(late, 2.0), "who comes later")
    assert "reach [mm]" not in late.labels() and late.value("object") == "other" and late.value("sensor") == "mini"
    late.close()


def test_what_is_saved_is_a_file_and_a_download(open_page, tmp_path):
    _, client = open_page(StillSession(), folder=tmp_path / "runs")
    client.set("save 3-D view", False)  # this client has no browser to draw it
    client.press("Step")
    client.until(lambda: at(client, 1.0))
    for kind, suffix in (("PNG", ".png"), ("GIF", ".gif"), ("Recording", ".npz")):
        client.press(kind)
        name = client.until(lambda: next((n for n in client.downloads if n.endswith(suffix)), None), kind)  # noqa: B023
        client.until(lambda: name in client.texts(), "the file's name")  # noqa: B023
        assert (tmp_path / "runs" / name).read_bytes() == b"".join(client.downloads[name])
    assert len(read_recording(next((tmp_path / "runs").glob("*.npz")))._states) == 2
    _, other = open_page(StillSession(), folder=None)
    assert "save 3-D view" not in other.labels()


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
