"""The ``raytac`` command: one subcommand a file, and one line for an error of the user."""

from __future__ import annotations

import io
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import Annotated

import tyro

from raytac import __version__
from raytac.cli.bake import BakeArgs
from raytac.cli.calibrate import CalibrateArgs
from raytac.cli.compare import CompareArgs
from raytac.cli.compare_real import CompareRealArgs
from raytac.cli.doctor import DoctorArgs
from raytac.cli.press import PressArgs
from raytac.cli.view import ViewArgs
from raytac.errors import RaytacError
from raytac.io.folder import DISK_ERRORS
from raytac.io.progress import Progress

__all__ = ["main"]

_Command = (
    Annotated[PressArgs, tyro.conf.subcommand("press")]
    | Annotated[BakeArgs, tyro.conf.subcommand("bake")]
    | Annotated[CalibrateArgs, tyro.conf.subcommand("calibrate")]
    | Annotated[CompareArgs, tyro.conf.subcommand("compare")]
    | Annotated[CompareRealArgs, tyro.conf.subcommand("compare-real")]
    | Annotated[ViewArgs, tyro.conf.subcommand("view")]
    | Annotated[DoctorArgs, tyro.conf.subcommand("doctor")]
)
_DESCRIPTION = "Simulate GelSight tactile sensors. `raytac --version` tells which raytac this is."


class _StandardError(logging.Handler):
    """Lines on standard error, above a bar of progress where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        if sys.stderr is not None:
            level = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
            Progress.write(f"raytac: {level}{record.getMessage()}", file=sys.stderr)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0: done; 1: the doctor found the default job broken; 2: wrong input, or a full disk; 130: Ctrl-C; 141: nobody reads the output any
    more.
    """
    args = sys.argv[1:] if args is None else args
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # of paths that this locale cannot write, as standard error does
    log, shown = logging.getLogger("raytac"), _StandardError(logging.INFO)
    before, formatted = log.level, warnings.formatwarning
    log.addHandler(shown)
    log.setLevel(logging.INFO)
    warnings.formatwarning = lambda message, *_, **__: f"raytac: warning: {message}\n"
    try:
        status = _run(args)
        if sys.stdout is not None:
            sys.stdout.flush()
        return status
    except BrokenPipeError:  # as of `raytac press coin | head -1`
        _drop_output()
        return 128 + signal.SIGPIPE
    except RaytacError as error:
        print(f"raytac: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise
        _drop_output()
        print(f"raytac: error: cannot write ({error})", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("raytac: interrupted, nothing written", file=sys.stderr)
        return 130
    finally:
        log.removeHandler(shown)
        log.setLevel(before)
        warnings.formatwarning = formatted


def _run(args: Sequence[str]) -> int:
    if list(args) == ["--version"]:
        print(f"raytac {__version__}")
        return 0
    command = tyro.cli(_Command, prog="raytac", description=_DESCRIPTION, args=args)  # type: ignore[call-overload]
    return command.run()


def _drop_output() -> None:
    """Discard the rest of standard output, so that the interpreter ends without another error."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
