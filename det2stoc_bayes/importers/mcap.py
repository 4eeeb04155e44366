"""Bags of ROS 2: an .mcap or .db3 file, or a rosbag2 folder, as one recording of its JointState messages."""

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import MODEL_UNITS, Asked, Contents, Log, Signal, SourceError, clock, numbers
from det2stoc_bayes.suggestions import choices

ABOUT = "JointState (and Float64MultiArray) messages of an .mcap, a .db3 or a rosbag2 folder, a bag a recording"
TAKES = ("clock",)
SETTINGS = {"states": "the topic whose joints are the model's, where several have JointState messages"}
STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
STAMPS = ("header", "received")
FIELDS = {"position": "qpos", "velocity": "qvel", "effort": None}  # a JointState's units are SI by its definition


def read(source: Path, asked: Asked, names: ModelNames) -> Contents:
    """Signals `<topic>/<joint>/position` ... ; `--clock header` or `received` says which stamp is a sample's time."""
    bags = _bags(source)
    logs, notes = [], []
    for path in bags:
        if asked.wanted(path.stem):
            log, told = _log(path, asked)
            logs.append(log)
            notes.append(told)
    return Contents(logs, notes)


def _bags(source: Path) -> list[Path]:
    """A bag, or a folder of them; a folder with metadata.yaml is one bag."""
    if not source.exists():
        raise SourceError(f"{source}: no such file or folder; allowed: .mcap, .db3, or a rosbag2 folder")
    if source.is_file() or (source / "metadata.yaml").is_file():
        found = [source]
    else:
        found = sorted(p for p in source.iterdir() if p.suffix in (".mcap", ".db3") or (p / "metadata.yaml").is_file())
    if not found or (found[0].is_file() and found[0].suffix not in (".mcap", ".db3")):
        raise SourceError(f"{source}: found no bag; allowed: .mcap, .db3, or a rosbag2 folder")
    return found


def _log(path: Path, asked: Asked) -> tuple[Log, str]:
    if asked.clock not in STAMPS:
        given = "nothing" if asked.clock is None else f"'{asked.clock}'"
        raise SourceError(
            f"{path.name}: --clock: found {given}; allowed: header (the stamp in each message) or received "
            "(when the bag got it)"
        )
    found: dict[tuple[str, str, str], tuple[list[int], list[float]]] = defaultdict(lambda: ([], []))
    topics: dict[str, str] = {}
    for topic, kind, received, message in _messages(path):
        if kind == ARRAY and asked.clock == "header":  # it has none
            if any(mapped.signal.startswith(f"{topic}/") for mapped in asked.columns.values()):
                raise SourceError(f"{path.name}: {topic}: {ARRAY} has no header; allowed: --clock received")
            continue
        topics[topic] = kind
        stamp = received
        if asked.clock == "header" and kind == STATE:
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            if stamp == 0:
                raise SourceError(f"{path.name}: {topic}: found an empty header stamp; allowed: --clock received")
        for key, value in _numbers(kind, message, f"{path.name}: {topic}"):
            times, values = found[topic, *key]
            times.append(stamp)
            values.append(value)
    if not found:
        raise SourceError(f"{path.name}: no message of {STATE} or {ARRAY}; allowed: a bag with some")
    return Log(path.stem, path.name, _signals(found, topics, asked, path.name)), f"{path.name}: {asked.clock} stamps"


def _signals(
    found: dict[tuple[str, str, str], tuple[list[int], list[float]]], topics: dict[str, str], asked: Asked, where: str
) -> dict[str, Signal]:
    """Signals on one clock [s], and the columns that a states topic's joints are."""
    states = [topic for topic, kind in topics.items() if kind == STATE]
    chosen = asked.settings.get("states", states[0] if len(states) == 1 else None)
    if chosen is None and len(states) > 1:
        raise SourceError(
            f"{where}: found JointState on {listing(states)}; give --set states=TOPIC; allowed: one of them"
        )
    if chosen is not None and chosen not in topics:
        raise SourceError(f"--set states: {where} has no topic '{chosen}'; {choices(chosen, states)}")
    zero = min(times[0] for times, _ in found.values())
    signals = {}
    for (topic, part, field), (times, values) in found.items():
        name = f"{topic}/{part}/{field}" if field else f"{topic}/{part}"
        start = FIELDS.get(field) if topic == chosen else None
        column = f"{start}/{part}" if start else None
        seconds = clock(np.array([t - zero for t in times]) * 1e-9, f"{where}: {name}")
        unit = MODEL_UNITS if topics[topic] == STATE else None
        signals[name] = Signal(seconds, numbers(values, f"{where}: {name}"), unit, column)
    return signals


def _messages(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, type, time of receipt [ns] and content of the messages that are read."""
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
    except ImportError as error:
        raise SourceError("mcap: needs the package rosbags; allowed: pip install 'det2stoc-bayes[import]'") from error
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            wanted = [c for c in bag.connections if c.msgtype in (STATE, ARRAY)]
            for connection, received, raw in bag.messages(connections=wanted):
                yield connection.topic, connection.msgtype, received, bag.deserialize(raw, connection.msgtype)
    except SourceError:
        raise
    except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SourceError(f"{path.name}: cannot be read: {reason}; allowed: a bag of ROS 2") from error


def _numbers(kind: str, message: Any, where: str) -> Iterator[tuple[tuple[str, str], float]]:
    """(part, field) and value of a message's numbers."""
    if kind == ARRAY:
        for i, value in enumerate(message.data):
            yield (str(i), ""), float(value)
        return
    for field in FIELDS:
        values = getattr(message, field)
        if len(values) and len(values) != len(message.name):
            raise SourceError(
                f"{where}: found {len(values)} {field}s of {len(message.name)} joints; allowed: one a joint"
            )
        for joint, value in zip(message.name, values, strict=False):
            yield (str(joint), field), float(value)
