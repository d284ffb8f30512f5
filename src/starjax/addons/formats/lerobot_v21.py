"""Writes a LeRobotDataset v2.1, as Open-H has it: a file per episode, and GR00T's modality.json.

meta/info.json, tasks.jsonl, episodes.jsonl, episodes_stats.jsonl
meta/modality.json                         parts of state and action by name
data/chunk-000/episode_000000.parquet
videos/chunk-000/<camera>/episode_000000.mp4
"""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as parquet

from starjax.addons.formats import base, lerobot, lerobot_card, lerobot_tables, video
from starjax.addons.formats.base import Source
from starjax.runtime import files
from starjax.sim.rollouts import episodes

_POSE, _ARM = 7, 8  # numbers of a tip pose, and of an arm with its gripper


def _write(path: Path, source: Source, with_video: bool) -> None:
    hz = lerobot_tables.whole_hz(source)
    features = lerobot_tables.features(source, hz, with_video)
    texts = {name: list(found) for name, found in source.texts(0).items()}
    features |= {name: {"dtype": "string", "shape": [1], "names": None} for name in texts}
    cameras = [name for name, column in source.columns.items() if column.is_image]
    rows, statistics, first = [], [], 0
    for episode, length in enumerate(source.lengths):
        arrays = source.read(episode, source.columns)
        arrays |= lerobot_tables.counted(episode, length, first, hz)
        _episode(path, episode, arrays, features, source, cameras if with_video else [], hz)
        figures = {
            name: lerobot_tables.stats(lerobot_tables.sampled(x) if name in cameras else x)
            for name, x in arrays.items()
        }
        rows.append({"episode_index": episode, "tasks": [source.task], "length": length})
        statistics.append({"episode_index": episode, "stats": figures})
        first += length
    _json_lines(path / "meta/episodes.jsonl", rows)
    _json_lines(path / "meta/episodes_stats.jsonl", statistics)
    _json_lines(path / "meta/tasks.jsonl", [{"task_index": 0, "task": source.task}])
    files.write_json(path / "meta/modality.json", modality(source))
    about = _info(source, features, hz, len(cameras) if with_video else 0)
    files.write_json(path / "meta/info.json", about)
    if source.origin:
        files.write_json(path / "meta" / f"{base.OURS}.json", source.origin)
    (path / "README.md").write_text(lerobot_card.card(about, source))


def _episode(
    path: Path,
    episode: int,
    arrays: dict[str, Any],
    features: dict[str, Any],
    source: Source,
    cameras: list[str],
    hz: int,
) -> None:
    """Writes the table and the videos of an episode."""
    chunk, name = f"chunk-{episode // lerobot_tables.CHUNK:03d}", f"episode_{episode:06d}"
    numeric = {key: feature for key, feature in features.items() if feature["dtype"] != "string"}
    table = lerobot_tables.table(numeric, arrays)
    for column, found in source.texts(episode).items():
        cells = pa.array([", ".join(found)] * source.lengths[episode])
        table = table.append_column(column, cells)
    file = path / "data" / chunk / f"{name}.parquet"
    file.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(table, file)
    for camera in cameras:
        file = path / "videos" / chunk / camera / f"{name}.mp4"
        file.parent.mkdir(parents=True, exist_ok=True)
        writer = video.Writer(file, arrays[camera].shape[1:], hz)
        writer.append(arrays[camera])
        writer.close()


def modality(source: Source) -> dict[str, Any]:
    """Returns the content of modality.json: tip poses, grippers, trocars and cameras by name."""
    state, action, trocar = (lerobot.named(name) for name in ("state", "action", "trocar"))
    # Columns of others are not known by part.
    count = source.columns[trocar].shape[0] // 3 if source.origin else 0
    width = source.columns[action].shape[0] // count if count else 0
    target = "tip_pose" if width == _ARM else "roll_and_tip"
    parts: dict[str, Any] = {"state": {}, "action": {}}
    for i in range(count):
        arm = f"arm{i}_" if count > 1 else ""
        first, last = i * _ARM, (i + 1) * width
        parts["state"][f"{arm}tip_pose"] = _span(first, first + _POSE, state)
        parts["state"][f"{arm}gripper"] = _span(first + _POSE, first + _ARM, state)
        parts["action"][f"{arm}{target}"] = _span(last - width, last - 1, action)
        parts["action"][f"{arm}gripper"] = _span(last - 1, last, action)
        parts["state"][f"{arm}trocar"] = _span(3 * i, 3 * i + 3, trocar)
    prefix = lerobot.named(episodes.IMAGE)
    parts["video"] = {
        name.removeprefix(prefix): {"original_key": name}
        for name, column in source.columns.items()
        if column.is_image
    }
    return parts | {"annotation": {"human.task_description": {"original_key": "task_index"}}}


def _span(start: int, end: int, column: str) -> dict[str, Any]:
    return {"start": start, "end": end, "original_key": column}


def _info(source: Source, features: dict[str, Any], hz: int, videos: int) -> dict[str, Any]:
    count = len(source.lengths)
    name = "chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    video_name = "chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    return {
        "codebase_version": "v2.1",
        "robot_type": source.robot,
        "total_episodes": count,
        "total_frames": sum(source.lengths),
        "total_tasks": 1,
        "total_videos": videos * count,
        "total_chunks": -(-count // lerobot_tables.CHUNK),
        "chunks_size": lerobot_tables.CHUNK,
        "fps": hz,
        "splits": lerobot_tables.splits(source),
        "data_path": f"data/{name}",
        "video_path": f"videos/{video_name}" if videos else None,
        "features": features,
    }


def _json_lines(path: Path, rows: list[Any]) -> None:
    text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
    files.write_bytes(path, text.encode())


FORMAT = lerobot.FORMAT._replace(description="LeRobotDataset v2.1, as Open-H's", write=_write)
