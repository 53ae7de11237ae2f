# MuJoCo's compiled module names its types and functions at run time and ships no stubs.
from typing import Any

def __getattr__(name: str) -> Any: ...
