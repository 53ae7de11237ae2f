"""Optical modes. Importing this package points Dr.Jit at a libLLVM that works, before anything can import ``drjit`` itself."""

import os as _os

from raytac.device import llvm_library as _llvm_library

# Dr.Jit reads this once, when it is first imported, and by default picks a system LLVM that may abort the whole process.
if (_library := _llvm_library()) is not None:
    _os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(_library))
