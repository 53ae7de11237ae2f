"""``dataset.json`` and ``README.md`` of a data set, without any path of the machine."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from raytac.dataset.arrays import ARRAYS, COLUMNS, SHARED, ArrayKind
from raytac.dataset.plan import DatasetPlan
from raytac.dataset.shard import ShardRecord, sha256_of
from raytac.errors import InputError
from raytac.io.atomic import read_regular, write_atomic

FILE = "dataset.json"
FORMAT_VERSION = 1
_KEYS = {
    "name": str,
    "complete": bool,
    "presses": int,
    "shards": int,
    "manifest_sha256": str,
    "arrays": dict,
    "arrays_of_a_shard": dict,
    "sensors": dict,
    "plan_sha256": str,
    "plan": dict,
}
"""Keys that readers need, and their types."""
_DTYPES = tuple(sorted({kind.dtype for kind in (*ARRAYS.values(), *SHARED.values())}))
"""Types that an array of a data set may have."""
_FRAME = (
    "pad frame: origin at the centre of the undeformed outer gel surface, +z out of the sensor towards the object, +x image right, "
    "+y image down; SI units"
)


def describe(plan: DatasetPlan, records: Sequence[ShardRecord], manifest: Path | None) -> dict[str, Any]:
    """All of ``dataset.json``; ``manifest`` is None while shards are missing."""
    made: dict[str, dict[str, Any]] = {}
    for record in records:
        key = json.dumps(record.made_by, sort_keys=True)
        made.setdefault(key, {**record.made_by, "shards": 0})["shards"] += 1
    status = [row["status"] for record in records for row in record.rows]
    sensors = {}
    for sensor in plan.sweep.sensors:
        shapes = plan.array_shapes(sensor)
        sensors[sensor.name] = {
            "resolution": list(plan.resolution(sensor)),
            "pixel_m": list(sensor.camera.pitch_at(plan.resolution(sensor))),
            "pad_size_m": list(sensor.gelpad.size),
            "pad_thickness_m": sensor.gelpad.thickness,
            "arrays": {name: ["N", *shape] for name, shape in shapes.items()},
        }
    return {
        "format": "raytac presses",
        "format_version": FORMAT_VERSION,
        "name": plan.sweep.name,
        "complete": manifest is not None,
        "presses": plan.sweep.count,
        "sound": status.count("ok"),
        "failed": status.count("failed"),
        "shards": plan.shards,
        "manifest_sha256": sha256_of(manifest) if manifest is not None else "",
        "frame": _FRAME,
        "arrays": {name: _declared(array, "N") for name, array in plan.arrays.items()},
        "arrays_of_a_shard": {name: _declared(array) for name, array in plan.shared.items()},
        "columns": {name: {"type": c.type, "unit": c.unit, "meaning": c.meaning} for name, c in COLUMNS.items()},
        "sensors": sensors,
        "made_by": list(made.values()),
        "plan_sha256": plan.digest,
        "plan": plan.description,
    }


def _declared(array: ArrayKind, *first: str) -> dict[str, Any]:
    return {"dtype": array.dtype, "shape": [*first, *array.shape], "unit": array.unit, "meaning": array.meaning}


def write_description(folder: Path, description: dict[str, Any]) -> None:
    """Write ``README.md`` and ``dataset.json``, the latter last."""
    for name, text in (("README.md", _readme(description)), (FILE, json.dumps(description, indent=1, ensure_ascii=False) + "\n")):
        write_atomic(folder / name, text.encode())


def read_description(folder: Path) -> dict[str, Any]:
    """``dataset.json`` of a data set; ``InputError`` for none, or for a damaged or later one."""
    path = Path(folder) / FILE
    try:
        description = json.loads(read_regular(path))
        version = description["format_version"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError("data set", value=folder, rule=f"must be a folder with a {FILE} ({type(error).__name__})") from error
    if version != FORMAT_VERSION:
        raise InputError("data set", value=version, rule=f"must be of format version {FORMAT_VERSION}")
    for key, kind in _KEYS.items():
        if type(description.get(key)) is not kind:
            raise InputError("data set", value=path, rule=f"must have a key {key!r} of type {kind.__name__}")
    if not isinstance(description["plan"].get("objects"), dict):
        raise InputError("data set", value=path, rule="must have the objects of its plan, by name")
    for name, item in {**description["arrays"], **description["arrays_of_a_shard"]}.items():
        if not isinstance(item, dict) or item.get("dtype") not in _DTYPES or not _is_shape(item.get("shape")):
            rule = f"must declare array {name!r} by a shape and a known dtype"
            raise InputError("data set", value=path, rule=rule, choices=_DTYPES)
    for name, sensor in description["sensors"].items():
        shapes = sensor.get("arrays") if isinstance(sensor, dict) else None
        if not isinstance(shapes, dict) or set(shapes) != set(description["arrays"]) or not all(map(_is_shape, shapes.values())):
            raise InputError("data set", value=path, rule=f"must have the shape of every array for sensor {name!r}")
    return description


def _is_shape(shape: object) -> bool:
    """True for a list of whole numbers >= 0 and names of sizes."""
    return isinstance(shape, list) and all((type(n) is int and n >= 0) or (isinstance(n, str) and n) for n in shape)


def _readme(description: dict[str, Any]) -> str:
    def table(items: dict[str, dict[str, Any]], kind: str) -> list[str]:
        lines = [f"| name | {kind} | unit | meaning |", "|---|---|---|---|"]
        for name, item in items.items():
            shape = f"{item['dtype']} ({', '.join(str(n) for n in item['shape'])})" if "shape" in item else item["type"]
            lines.append(f"| `{name}` | {shape} | {item['unit']} | {item['meaning']} |")
        return lines

    lines = [
        f"# {description['name']}",
        "",
        f"{description['presses']} simulated presses of {', '.join(description['plan']['objects'])} into "
        f"{', '.join(description['sensors'])}, by raytac: "
        f"{description['sound']} sound, {description['failed']} failed, {description['shards']} shards. "
        + ("Complete." if description["complete"] else "NOT complete: run the same command again."),
        "",
        f"Frame: {description['frame']}.",
        "",
        "- `manifest.parquet`: one row a press, in the order of their numbers; failed ones with their reason.",
        "- `shards/NNNNNN.npz`: arrays of the sound presses of one shard, `numpy.load` reads them; SHA-256 of every file in the manifest.",
        "- `shards/NNNNNN.json`: the rows of that shard, from which the manifest is made.",
        "- `dataset.json`: all of this page, the plan, versions and state of the code for programs.",
        "",
        "```python",
        "from raytac.dataset import PressDataset",
        "",
        'data = PressDataset("THIS_FOLDER", ("rgb", "wrench"))',
        'data[0]["rgb"]',
        "```",
        "",
        "## Arrays of a shard, the press first",
        "",
        *table(description["arrays"], "type (shape)"),
        "",
        "## Arrays of a shard, once",
        "",
        *table(description["arrays_of_a_shard"], "type (shape)"),
        "",
        "H, W: image; Ny, Nx: grid over the pad; M: markers; T: frames. By sensor:",
        "",
        *(
            f"- `{name}`: " + ", ".join(f"{key} {tuple(shape)}" for key, shape in sensor["arrays"].items())
            for name, sensor in description["sensors"].items()
        ),
        "",
        "## Columns of the manifest",
        "",
        *table(description["columns"], "type"),
        "",
    ]
    return "\n".join(lines)
