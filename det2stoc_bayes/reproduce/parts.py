"""Parts of a long experiment, each kept on disk as soon as it is made."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from det2stoc_bayes.files import atomic_write

Progress = Callable[[str, int, int], None]  # stage, done, total


def kept(path: Path, asked: Mapping[str, Any], make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
    """What is in the file, where it was made under the same settings; else made and written now."""
    wanted = json.loads(json.dumps(asked))  # tuples are lists there
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, json.JSONDecodeError):
        found = None
    if isinstance(found, dict) and found.get("asked") == wanted:
        return found
    made = {"asked": wanted, **make()}
    atomic_write(path, json.dumps(made))
    return json.loads(json.dumps(made))
