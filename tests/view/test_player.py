"""The player: what is commanded happens, in order, once; storms are coalesced, errors told, and the thread ends when it must."""

from __future__ import annotations

import threading
import time

import pytest

from raytac.errors import InputError
from raytac.view.player import Player, Status
from raytac.view.session import Snapshot
from tests.view.still import LENGTH, StillSession


class Watched:
    """A player with what it showed."""

    def __init__(self, session: StillSession) -> None:
        self.session, self.shown, self.news = session, [], threading.Condition()
        self.player = Player(session, self.show)

    def show(self, snapshot: Snapshot | None, status: Status) -> None:
        with self.news:
            self.shown.append((None if snapshot is None else snapshot.controls["reach"], status))
            self.news.notify_all()

    def until(self, happened) -> Status:
        with self.news:
            assert self.news.wait_for(lambda: bool(self.shown) and happened(self.shown[-1][1]), 10.0), self.shown[-3:]
            return self.shown[-1][1]

    @property
    def values(self) -> list[float]:
        return [value for value, _ in self.shown if value is not None]


@pytest.fixture
def watched():
    made = Watched(StillSession())
    made.player.start()
    made.until(lambda s: s.mode == "paused")
    yield made
    made.session.gate.set()
    assert made.player.close(10.0)


def test_the_start_is_shown_and_nothing_moves(watched):
    time.sleep(0.1)
    assert watched.values == [0.0] and watched.player.status == Status("paused")


def test_playing_goes_through_every_state_and_pauses_at_the_end(watched):
    watched.player.play()
    status = watched.until(lambda s: s.mode == "paused" and s.count == LENGTH)
    assert watched.values == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert status.states_per_s == 0.0
    rates = [s.states_per_s for _, s in watched.shown if s.mode == "playing"]
    assert all(0.0 < rate <= 31.0 for rate in rates)  # paced, so that no line is flooded


def test_step_is_one_state_and_play_after_the_end_begins_anew(watched):
    for count in range(1, LENGTH + 1):
        watched.player.step()
        watched.until(lambda s, count=count: s.count == count)
    assert watched.values[-1] == LENGTH and watched.player.status.mode == "paused"
    watched.player.step()
    watched.until(lambda s: s.count == LENGTH + 1)
    assert watched.values[-1] == 1.0


def test_pause_stops_on_the_way_and_reset_goes_back(watched):
    watched.session.gate.clear()
    watched.player.play()
    watched.player.pause()
    watched.session.gate.set()
    watched.until(lambda s: s.mode == "paused" and s.count == 1)
    watched.player.reset()
    watched.until(lambda s: s.count == 0)
    assert watched.values[-1] == 0.0 and watched.session.calls[-1] == "reset"


def test_a_storm_of_targets_is_coalesced_and_the_latest_is_reached(watched):
    watched.session.gate.clear()
    watched.player.drive("reach", 1.0)
    watched.until(lambda s: True)
    time.sleep(0.05)  # the thread has taken the first and waits
    for k in range(500):
        watched.player.drive("reach", k % 50 / 10.0)
    watched.player.drive("push", 9.0)
    watched.player.drive("reach", 3.5)
    watched.session.gate.set()
    watched.until(lambda s: s.mode == "paused" and s.count >= 4)
    assert watched.values[-1] == 3.5
    driven = [call for call in watched.session.calls if isinstance(call, dict)]
    assert driven == [{"reach": 1.0}, {"push": 9.0, "reach": 3.5}]


def test_a_reset_voids_what_was_asked_before(watched):
    watched.session.gate.clear()
    watched.player.drive("reach", 2.0)
    time.sleep(0.05)
    watched.player.drive("reach", 50.0)
    watched.player.play()
    watched.player.reset()
    watched.session.gate.set()
    watched.until(lambda s: s.mode == "paused" and s.count == 0 and watched.session.calls[-1] == "reset")
    time.sleep(0.1)
    assert watched.values[-1] == 0.0 and {"reach": 50.0} not in watched.session.calls


@pytest.mark.parametrize(("value", "text"), [(13.0, "13 cannot be reached"), (14.0, "ZeroDivisionError: fourteen")])
def test_an_error_is_told_and_the_next_command_works(watched, capsys, value, text):
    watched.player.drive("reach", value)
    status = watched.until(lambda s: bool(s.error))
    assert status.error == text and status.mode == "paused"
    assert ("Traceback" in capsys.readouterr().err) == (value == 14.0)  # a fault of ours is printed in full, a user's is not
    watched.player.step()
    assert watched.until(lambda s: s.count == 1).error == ""


def test_what_cannot_be_drawn_is_told_too():
    session, seen = StillSession(), []

    def show(snapshot, status):
        seen.append(status)
        if snapshot is not None:
            raise InputError("colour", value="blue", rule="must be warm")

    player = Player(session, show)
    player.start()
    for _ in range(100):
        if seen and seen[-1].error:
            break
        time.sleep(0.02)
    assert "must be warm" in seen[-1].error and player.close(10.0)


def test_where_time_is_simulated_a_control_waits_for_play():
    watched = Watched(StillSession(is_driven_at_rest=False))
    watched.player.start()
    watched.player.drive("reach", 4.0)
    watched.until(lambda s: {"reach": 4.0} in watched.session.calls)
    time.sleep(0.05)
    assert watched.values == [0.0]
    assert watched.player.close(10.0)


def test_an_unknown_control_is_refused(watched):
    with pytest.raises(InputError, match="reach, push"):
        watched.player.drive("pull", 1.0)


def test_closing_ends_the_thread_at_once_while_it_plays(watched):
    watched.player.play()
    assert watched.player.close(5.0)
    assert watched.player.status.mode == "stopped"
    assert not any(thread.name == "raytac-view-player" for thread in threading.enumerate())
