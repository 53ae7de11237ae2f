"""``python -m raytac`` is the ``raytac`` command."""

from __future__ import annotations

import sys

from raytac.cli import main

if __name__ == "__main__":
    sys.exit(main())
