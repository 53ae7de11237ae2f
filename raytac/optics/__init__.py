"""Optical modes; importing them gives Dr.Jit a working libLLVM before ``drjit`` is imported."""

import os as _os

import lazy_loader as _lazy

from raytac.device import llvm_library as _llvm_library

# Dr.Jit takes an empty path as a library that was chosen, and then aborts the process; to us it is one that was not.
for _name in [_name for _name, _path in _os.environ.items() if _name.startswith("DRJIT_LIB") and not _path]:
    del _os.environ[_name]
# Dr.Jit reads this once, when it is first imported, and by default picks a system LLVM that may abort the whole process.
if (_library := _llvm_library()) is not None:
    _os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(_library))

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
