# MuJoCo ships no type stubs, and its names come from extension modules that pyright cannot read.
from typing import Any

def __getattr__(name: str) -> Any: ...
