"""LeRobot's layout: the files that its reader opens, read by pyarrow, pandas and LeRobot itself where these are installed."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from raytac.dataset import Episode, write_lerobot
from raytac.dataset import lerobot as module
from raytac.errors import InputError

FPS = 20
OWN = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"}


def episode(length: int, seed: int, **changed: Any) -> Episode:
    rng = np.random.default_rng(seed)
    arrays = {
        "left_rgb": rng.integers(0, 256, (length, 6, 8, 3), np.uint8),
        "wrench": rng.standard_normal((length, 6)),
        "height": rng.standard_normal((length, 3, 4)).astype(np.float32),
        "contact": rng.random((length, 3, 4)) < 0.5,
        "action": rng.standard_normal((length, 2)).astype(np.float32),
        "reward": rng.standard_normal(length).astype(np.float32),
        "terminated": np.arange(length) == length - 1,
        "truncated": np.zeros(length, bool),
        "steps": np.arange(length, dtype=np.int32),
    }
    facts = {"object": f"thing {seed}", "label": seed, "mass": 0.5 * seed}
    made = {"arrays": arrays, "fps": float(FPS), "task": "lift" if seed % 2 else "push", "facts": facts}
    return Episode(**{**made, **changed})


EPISODES = [episode(5, 1), episode(3, 2), episode(4, 3)]
TOTAL = sum(map(len, EPISODES))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("lerobot") / "set"
    assert write_lerobot(made, iter(EPISODES), robot_type="panda") == made
    return made


def info_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta/info.json").read_text())


def test_info_is_as_the_format_says(folder: Path) -> None:
    info = info_of(folder)
    features = info.pop("features")
    assert info == {
        "codebase_version": "v3.0",
        "robot_type": "panda",
        "total_episodes": 3,
        "total_frames": TOTAL,
        "total_tasks": 2,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": "0:3"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
    }
    expected = {
        "observation.images.left_rgb": ("image", [6, 8, 3]),
        "observation.wrench": ("float32", [6]),
        "observation.height": ("float32", [3, 4]),
        "observation.contact": ("bool", [3, 4]),
        "observation.steps": ("int64", [1]),
        "action": ("float32", [2]),
        "next.reward": ("float32", [1]),
        "next.done": ("bool", [1]),
        "object": ("string", [1]),
        "label": ("int64", [1]),
        "mass": ("float32", [1]),
        **{name: (dtype, [1]) for name, dtype in OWN.items()},
    }
    assert {name: (item["dtype"], item["shape"]) for name, item in features.items()} == expected
    assert features["observation.images.left_rgb"]["names"] == ["height", "width", "channels"]


def test_frames_are_read_back_from_the_file_that_the_index_names(folder: Path) -> None:
    info, places = info_of(folder), pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in places] == [5, 3, 4] and [row["tasks"] for row in places] == [["lift"], ["push"], ["lift"]]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in places] == [(0, 5), (5, 8), (8, 12)]
    for number, (row, one) in enumerate(zip(places, EPISODES, strict=True)):
        path = folder / info["data_path"].format(chunk_index=row["data/chunk_index"], file_index=row["data/file_index"])
        table = pq.read_table(path, filters=[("episode_index", "=", number)])
        assert table.column_names == list(info["features"])
        assert table["index"].to_pylist() == list(range(row["dataset_from_index"], row["dataset_to_index"]))
        assert table["frame_index"].to_pylist() == list(range(len(one)))
        np.testing.assert_allclose(table["timestamp"].to_numpy(), np.arange(len(one)) / FPS, rtol=1e-6)
        for name, key in (("wrench", "observation.wrench"), ("height", "observation.height"), ("action", "action")):
            np.testing.assert_allclose(np.array(table[key].to_pylist()), one.arrays[name].astype(np.float32))
        assert table["observation.contact"].to_pylist() == one.arrays["contact"].tolist()
        assert table["next.done"].to_pylist() == one.arrays["terminated"].tolist()
        assert set(table["object"].to_pylist()) == {one.facts["object"]} and set(table["label"].to_pylist()) == {
            one.facts["label"]
        }
        for image, stored in zip(one.arrays["left_rgb"], table["observation.images.left_rgb"].to_pylist(), strict=True):
            with Image.open(io.BytesIO(stored["bytes"])) as opened:
                np.testing.assert_array_equal(np.asarray(opened), image)
    for name in ("observation.wrench", "action"):
        kind = pq.read_schema(folder / "data/chunk-000/file-000.parquet").field(name).type
        assert pa.types.is_fixed_size_list(kind) and kind.list_size == info["features"][name]["shape"][0]
    assert pq.ParquetFile(folder / "data/chunk-000/file-000.parquet").num_row_groups == 3


def test_tasks_are_an_index_for_pandas(folder: Path) -> None:
    table = pq.read_table(folder / "meta/tasks.parquet")
    assert dict(zip(table["task"].to_pylist(), table["task_index"].to_pylist(), strict=True)) == {"lift": 0, "push": 1}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    frames = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    assert frames["task_index"].to_pylist() == [0] * 5 + [1] * 3 + [0] * 4
    pandas = pytest.importorskip("pandas")
    read = pandas.read_parquet(folder / "meta/tasks.parquet")
    assert read.index.name == "task" and read.loc["push"].task_index == 1 and list(read.columns) == ["task_index"]


def test_statistics_are_those_of_all_frames(folder: Path) -> None:
    statistics = json.loads((folder / "meta/stats.json").read_text())
    joined = {name: np.concatenate([one.arrays[name] for one in EPISODES]).astype(float) for name in EPISODES[0].arrays}
    wrench = statistics["observation.wrench"]
    for key, function in (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std)):
        np.testing.assert_allclose(wrench[key], function(joined["wrench"], axis=0), rtol=1e-5, atol=1e-7)
        image = np.array(statistics["observation.images.left_rgb"][key])
        assert image.shape == (3, 1, 1)
        np.testing.assert_allclose(image[:, 0, 0], function(joined["left_rgb"], axis=(0, 1, 2)) / 255.0, rtol=1e-6)
    assert wrench["count"] == statistics["observation.images.left_rgb"]["count"] == [TOTAL]
    assert "object" not in statistics and set(OWN) < set(statistics)
    first = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    np.testing.assert_allclose(first["stats/observation.wrench/mean"], EPISODES[0].arrays["wrench"].mean(axis=0), rtol=1e-5)
    assert first["stats/action/count"] == [5] and np.shape(first["stats/observation.images.left_rgb/std"]) == (3, 1, 1)


def test_a_full_file_is_followed_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_FILE_MB", 0)
    monkeypatch.setattr(module, "_FILES_IN_CHUNK", 2)
    folder = write_lerobot(tmp_path / "set", EPISODES)
    files = sorted(path.relative_to(folder / "data").as_posix() for path in (folder / "data").rglob("*.parquet"))
    assert files == ["chunk-000/file-000.parquet", "chunk-000/file-001.parquet", "chunk-001/file-000.parquet"]
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["data/chunk_index"], row["data/file_index"]) for row in rows] == [(0, 0), (0, 1), (1, 0)]
    for row, file in zip(rows, files, strict=True):
        assert set(pq.read_table(folder / "data" / file)["episode_index"].to_pylist()) == {row["episode_index"]}


def test_features_are_renamed(tmp_path: Path) -> None:
    folder = write_lerobot(tmp_path / "set", EPISODES, names={"wrench": "observation.state", "terminated": "next.terminated"})
    features = info_of(folder)["features"]
    assert features["observation.state"]["shape"] == [6] and {"next.terminated", "next.done"} <= set(features)
    assert "observation.wrench" not in features


@pytest.mark.parametrize(
    ("episodes", "options", "message"),
    [
        ([], {}, "at least one episode"),
        ([1], {}, "iterable of episodes"),
        ([episode(3, 1, fps=12.5)], {}, "whole number"),
        ([episode(3, 1), episode(3, 1, fps=10.0)], {}, "fps of episode 1"),
        ([episode(3, 1), episode(3, 1, facts={})], {}, "episode 1 .*features of the first"),
        ([episode(3, 1)], {"names": {"wrong": "x"}}, "names = 'wrong'"),
        ([episode(3, 1)], {"names": {"wrench": "action"}}, "a feature of its own"),
        ([episode(3, 1)], {"names": {"wrench": "index"}}, "a feature of its own"),
        ([episode(3, 1)], {"names": {"wrench": "a/b"}}, "without '/'"),
        ([Episode({"x": np.zeros((2, 1, 1, 1, 1, 1, 1))}, 5.0)], {}, "at most 5 axes"),
    ],
)
def test_what_lerobot_does_not_have_leaves_nothing(
    episodes: list[Any], options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        write_lerobot(tmp_path / "set", episodes, **options)
    assert not any(tmp_path.iterdir())


def test_lerobot_itself_reads_it(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    pytest.importorskip("lerobot")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

    data = LeRobotDataset("raytac/test", root=folder, delta_timestamps={"action": [0.0, 1.0 / FPS]})
    assert len(data) == TOTAL and data.num_episodes == 3 and data.fps == FPS
    at = 0
    for one in EPISODES:
        for t in range(len(one)):
            item = data[at + t]
            assert item["task"] == one.task and item["object"] == one.facts["object"]
            shown = item["observation.images.left_rgb"].numpy()  # (3, H, W) in [0, 1]
            np.testing.assert_allclose(shown.transpose(1, 2, 0) * 255.0, one.arrays["left_rgb"][t], atol=1e-3)
            np.testing.assert_allclose(item["observation.wrench"].numpy(), one.arrays["wrench"][t], rtol=1e-5)
            np.testing.assert_allclose(item["observation.height"].numpy(), one.arrays["height"][t], rtol=1e-6)
            following = one.arrays["action"][[t, min(t + 1, len(one) - 1)]]
            np.testing.assert_allclose(item["action"].numpy(), following, rtol=1e-6)
            assert bool(item["next.done"]) == (t == len(one) - 1)
        at += len(one)
    assert data.meta.stats["observation.images.left_rgb"]["mean"].shape == (3, 1, 1)
