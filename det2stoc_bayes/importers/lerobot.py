"""LeRobot data sets, version 3: parquet files of many episodes each, and meta/info.json. An episode is a recording."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import Asked, Contents, Log, Signal, SourceError, clock, numbers

ABOUT = ("a LeRobot v3 data set's folder, an episode a recording; joints' units are asked for; timestamp is in s, "
         "in full where it is frame_index / fps")  # fmt: skip
TAKES: tuple[str, ...] = ()
SETTINGS: Mapping[str, str] = {}
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Signals `observation.state/<joint>`, `action/<joint>` ... of every episode."""
    import pyarrow as pa
    from pyarrow import parquet

    info = _info(source)
    paths = sorted((source / "data").glob("*/*.parquet"))
    if not paths:
        raise SourceError(f"{source}: found no data/*/*.parquet; allowed: a LeRobot v3 folder")
    features = {k: v for k, v in info["features"].items() if str(v.get("dtype", "")).startswith(("float", "int"))}
    features = {k: v for k, v in features.items() if k not in INDICES}
    logs: list[Log] = []
    for path in paths:
        try:
            with parquet.ParquetFile(path) as file:
                columns = file.schema_arrow.names
                there = {name: feature for name, feature in features.items() if name in columns}
                content = file.read([*(name for name in INDICES if name in columns), *there])  # and no pictures
        except (pa.ArrowException, OSError) as error:
            raise SourceError(f"{path.name}: cannot be read: {str(error).splitlines()[0]}; allowed: Parquet") from error
        missing = [name for name in ("timestamp", "episode_index") if name not in columns]
        if missing:
            raise SourceError(f"{path.name}: no column {missing[0]}; found {listing(columns)}; "
                              "allowed: a LeRobot v3 file")  # fmt: skip
        logs += _episodes(path, content, there, info.get("fps"), asked)
    seen = [log.name for log in logs]
    if len(set(seen)) < len(seen):
        raise SourceError(f"{source}: an episode lies in two files; allowed: one")
    notes = [f"robot_type {info.get('robot_type')}, fps {info.get('fps')}, {info['codebase_version']}"]
    return Contents(logs, notes)


def _info(source: Path) -> dict[str, Any]:
    path = source / "meta" / "info.json"
    if not path.is_file():
        raise SourceError(f"{source}: no meta/info.json; allowed: the folder of a LeRobot v3 data set")
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, UnicodeDecodeError) as error:
        raise SourceError(f"meta/info.json: cannot be read: {error}; allowed: JSON") from error
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith("v3."):
        raise SourceError(f"meta/info.json: codebase_version: found {version!r}; allowed: v3.0 and later of 3 "
                          "(LeRobot converts older ones)")  # fmt: skip
    if not isinstance(info.get("features"), dict):
        raise SourceError("meta/info.json: features: missing; allowed: a table of them")
    return info


def _episodes(path: Path, content: Any, features: Mapping[str, Any], rate: object, asked: Asked) -> Iterator[Log]:
    """The episodes of one file."""
    episode = numbers(content["episode_index"].to_numpy(), f"{path.name}: episode_index").astype(int)
    stamps = _stamps(content, rate, path.name)
    columns: dict[str, tuple[str, np.ndarray]] = {}
    for name, feature in features.items():
        rows = content[name].to_pylist()
        values = numbers(rows, f"{path.name}: {name}").reshape(len(rows), -1)
        for label, signal in zip(_labels(name, feature, values.shape[1]), values.T, strict=True):
            columns[f"{name}/{label}" if label else name] = (label, signal)
    for number in sorted(set(episode.tolist())):
        label = f"episode_{number:03d}"
        if asked.wanted(label):
            rows = episode == number
            time = clock(stamps[rows], f"{path.name}: {label}: timestamp")
            yield Log(label, f"{path.name}: {label}", {
                name: Signal(time, values[rows], None, column or name) for name, (column, values) in columns.items()
            })  # fmt: skip


def _stamps(content: Any, rate: object, where: str) -> Float[np.ndarray, " samples"]:
    """LeRobot stamps frame_index / fps, rounded to float32 (to 4 us after a minute): here in full where that is so."""
    stamps = numbers(content["timestamp"].to_numpy(), f"{where}: timestamp")
    if "frame_index" not in content.column_names or not isinstance(rate, int | float) or not rate > 0:
        return stamps
    full = numbers(content["frame_index"].to_numpy(), f"{where}: frame_index") / rate
    return full if np.array_equal(full.astype(np.float32), stamps.astype(np.float32)) else stamps


def _labels(name: str, feature: Mapping[str, Any], width: int) -> list[str]:
    """The names of a feature's components: a list, or in a table of one kind, or of names and places; or numbers."""
    given = feature.get("names")
    if isinstance(given, dict):
        placed = {place: name for name, place in given.items() if isinstance(place, int)}
        given = [placed[i] for i in sorted(placed)] if placed else next(iter(given.values()), None)
    if isinstance(given, list) and all(isinstance(g, str) for g in given) and len(feature.get("shape") or ()) < 2:
        if len(given) != width:
            raise SourceError(
                f"meta/info.json: features.{name}.names: found {len(given)}; allowed: {width}, as in the data"
            )
        return list(given) if len(set(given)) == width else [f"{i}" for i in range(width)]
    return [""] if width == 1 else [f"{i}" for i in range(width)]
