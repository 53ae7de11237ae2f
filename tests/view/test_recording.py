"""What users save: recordings come back as they were, films and pictures are files that others open, limits hold."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from raytac.errors import BackendError, InputError
from raytac.io.films import gif_bytes, mp4_bytes
from raytac.view import saving
from raytac.view.history import History
from raytac.view.pictures import PICTURES, HeightScale, film_picture, films_equal_size, picture, pictures_of
from raytac.view.recording import Stage, StatesSession, read_recording, recording_bytes
from raytac.view.saving import MOST_PICTURES, Saver
from raytac.view.session import PadView, Snapshot
from tests.view.still import StillSession


def states(count: int) -> list[Snapshot]:
    session, kept = StillSession(), []
    for _ in range(count):
        kept.append(session.snapshot())
        session.at += 1.0
    return kept


class Client:
    """Browser that keeps its downloads."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}

    def send_file_download(self, name: str, data: bytes, *, save_immediately: bool) -> None:
        self.files[name] = data


def save(saver: Saver, kind: str, kept: list[Snapshot], view: Any = lambda *_: None) -> tuple[str, Client]:
    client = Client()
    text, _ = saver.save(kind, StillSession(), kept[-1], kept, picture=PICTURES[0], arrows=True, view=view, client=client)
    return text, client


def test_a_recording_comes_back_and_plays_on_a_timeline(tmp_path):
    path, kept = tmp_path / "a.npz", states(4)
    path.write_bytes(recording_bytes(StillSession(), kept))
    played = read_recording(path)
    assert (played.title, played.camera, played.handle) == (StillSession.title, StillSession.camera, None)
    np.testing.assert_array_equal(played.solids[0].faces, StillSession.solids[0].faces)
    for k, state in enumerate(kept):
        if k:
            assert played.advance()
        shown = played.snapshot()
        assert shown.facts == {"state": f"{k} of 3", "at": f"{k}"} and shown.controls == {"timeline": k}
        for name in ("rgb", "rest_rgb", "wrench", "height", "normals", "vertices"):
            np.testing.assert_allclose(getattr(shown.pads["left"], name), getattr(state.pads["left"], name), rtol=1e-6)
    assert not played.advance()
    played.drive({"timeline": 1.0})
    assert played.advance() and played.snapshot().facts["state"] == "1 of 3" and not played.advance()
    played.resume()
    assert played.advance() and played.snapshot().facts["state"] == "2 of 3"
    played.reset()
    assert played.snapshot().facts["state"] == "0 of 3"
    with pytest.raises(InputError, match="within 0 and 3"):
        played.drive({"timeline": 4.0})


def test_what_is_no_recording_is_told(tmp_path):
    whole = recording_bytes(StillSession(), states(2))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    np.savez(tmp_path / "objects.npz", document=np.array([object()], dtype=object))
    for name, rule in (("none.npz", "exists"), ("other.npz", "saved"), ("cut.npz", "saved"), ("objects.npz", "saved")):
        with pytest.raises(InputError, match=rule):
            read_recording(tmp_path / name)
    with pytest.raises(InputError, match="at least one"):
        StatesSession(Stage.of(StillSession()), [])


def test_a_png_is_of_one_state_and_a_gif_of_all(tmp_path):
    saver, kept = Saver(tmp_path / "runs" / "view"), states(5)
    assert not (tmp_path / "runs").exists()  # nothing is written before
    text, client = save(saver, "PNG", kept)
    (name,) = client.files
    assert name.startswith("still_") and (saver.folder / name).read_bytes() == client.files[name] and "1 state" in text
    small = Image.open(io.BytesIO(client.files[name]))
    _, client = save(saver, "PNG", kept, view=lambda state, height: np.zeros((height, height, 3), np.uint8))
    wide = Image.open(io.BytesIO(next(iter(client.files.values()))))
    assert wide.width > small.width + 700 and len(list(saver.folder.iterdir())) == 2
    text, client = save(saver, "GIF", kept)
    film = Image.open(io.BytesIO(next(iter(client.files.values()))))
    assert film.n_frames == 5 and "5 states" in text and film.size[0] % 2 == 0  # type: ignore[attr-defined]
    text, client = save(saver, "Recording", kept)
    (name,) = client.files
    assert len(read_recording(saver.folder / name)._states) == 5


def test_a_long_film_leaves_states_out_and_mp4_says_what_it_needs(tmp_path, monkeypatch):
    drawn: list[int] = []
    monkeypatch.setattr(saving, "gif_bytes", lambda pictures, rate: drawn.append(len(pictures)) or b"GIF")
    save(Saver(tmp_path), "GIF", states(1) * (MOST_PICTURES + 50))
    assert drawn == [MOST_PICTURES]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    text, client = save(Saver(tmp_path), "MP4", states(2))
    assert "pip install 'raytac[video]'" in text and not client.files
    with pytest.raises(BackendError):
        mp4_bytes([np.zeros((4, 4, 3), np.uint8)], 5.0)


def test_an_mp4_can_be_read(tmp_path):
    reader = pytest.importorskip("imageio_ffmpeg")
    pictures = [np.full((64, 96, 3), 10 * k, np.uint8) for k in range(12)]
    path = tmp_path / "a.mp4"
    path.write_bytes(mp4_bytes(pictures, 10.0))
    frames = reader.read_frames(str(path))
    assert next(frames)["size"] == (96, 64)
    assert 10 <= sum(1 for _ in frames) <= 12


def test_a_folder_that_cannot_be_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    text, client = save(Saver(tmp_path / "file"), "PNG", states(1))
    assert "file" in text and not client.files


def test_the_history_forgets_the_oldest_and_has_its_numbers():
    history = History(most_bytes=10**9, most_states=3)
    for number, state in enumerate(states(5)):
        history.add(number, state)
    assert len(history) == 3 and history.dropped == 2 and history.x.tolist() == [2.0, 3.0, 4.0] and history.x_label == "state"
    assert history.forces("left")[2].tolist() == [-2.0, -3.0, -4.0] and np.isnan(history.displacements("left")).all()
    history.add(4, states(1)[0])  # the same state drawn again
    assert len(history) == 3 and history.forces("left")[2].tolist() == [-2.0, -3.0, 0.0]
    small = History(most_bytes=1)
    for number, state in enumerate(states(3)):
        small.add(number, state)
    assert len(small) == 1 and small.x.tolist() == [2.0]


def test_difference_height_and_normals_are_what_they_say():
    rest = np.full((2, 2, 3), 100, np.uint8)
    rgb = rest + np.array([0, 10, 255 - 100], np.uint8)
    height = np.array([[0.0, -1e-3], [np.nan, -5e-4]])
    normals = np.broadcast_to([0.0, 0.0, -1.0], (2, 2, 3))
    pad = PadView(np.eye(4), np.zeros((1, 3)), {}, rgb=rgb, rest_rgb=rest, height=height, normals=normals)
    difference = picture(pad, PICTURES[1])
    assert difference is not None and difference[0, 0].tolist() == [128, 148, 255]
    flat = picture(pad, "normals")
    assert flat is not None and flat[0, 0].tolist() == [128, 128, 255]
    scale = HeightScale()
    scale.include(pad)
    assert (scale.low, scale.high) == (pytest.approx(-1e-3), 0.0) and "-1.00 mm" in scale.label
    drawn = picture(pad, "height", heights=scale)
    assert drawn is not None and drawn[0, 0].tolist() == [253, 231, 37] and drawn[0, 1].tolist() == [68, 1, 84]
    assert pictures_of({"a": pad}) == PICTURES
    assert pictures_of({"a": PadView(np.eye(4), np.zeros((1, 3)), {}, rgb=rgb)}) == ("tactile image",)


def test_films_have_one_size_and_gifs_one_palette():
    narrow, wide = np.zeros((10, 20, 3), np.uint8), np.full((10, 40, 3), 200, np.uint8)
    sheets = films_equal_size([narrow, wide])
    assert {sheet.shape for sheet in sheets} == {(10, 40, 3)}
    film = Image.open(io.BytesIO(gif_bytes(sheets, 10.0)))
    assert film.info["duration"] == 100
    sheet = film_picture(states(1)[0], PICTURES[0], arrows=False, heights=HeightScale())
    assert sheet.dtype == np.uint8 and sheet.shape[0] % 2 == 0 and sheet.shape[1] % 2 == 0


def test_a_gif_puts_no_grain_on_a_smooth_image() -> None:
    row = np.linspace(30, 190, 320)
    smooth = np.stack([np.tile(row, (240, 1)), np.tile(row[::-1], (240, 1)), np.full((240, 320), 90.0)], axis=-1).astype(np.uint8)
    shown = np.asarray(Image.open(io.BytesIO(gif_bytes([smooth, smooth], 10.0))).convert("RGB")).astype(int)
    assert np.abs(shown - smooth).max() <= 3
    assert (np.diff(shown[..., 0], axis=1) >= 0).all()  # as the image itself; dithering goes to and fro
