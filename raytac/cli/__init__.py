"""The ``raytac`` command: one subcommand a file, and one line for an error of the user."""

from __future__ import annotations

import importlib
import io
import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from raytac import __version__
from raytac.device import library_missing
from raytac.errors import BackendError, InputError, RaytacError
from raytac.io.folder import DISK_ERRORS
from raytac.io.progress import Progress

__all__ = ["main"]

COMMANDS = {
    "press": ("PressArgs", "press an object into the gel: image, height, forces, preview"),
    "view": ("ViewArgs", "a scene in the browser, with sliders that press or steer"),
    "dataset": ("DatasetArgs", "press objects many times: a data set of images and forces"),
    "compare": ("CompareArgs", "error of the image modes beside their time, as a report"),
    "compare-physics": ("ComparePhysicsArgs", "the same presses on rigid and soft pads, as a report"),
    "train": ("TrainArgs", "train a policy for a task by PPO, on the CPU or one GPU"),
    "play": ("PlayArgs", "play a policy: a film with tactile images, and a success rate"),
    "bake": ("BakeArgs", "bake a Taxim table from the ray tracer of a sensor"),
    "calibrate": ("CalibrateArgs", "fit a sensor to photographs or forces, or its markers to the soft pad"),
    "compare-real": ("CompareRealArgs", "fit to some photographs of presses and test on the others"),
    "doctor": ("DoctorArgs", "try everything that the jobs need, and say how to fix it"),
}
"""Class of each command, in the module of its name, and its line in the overview."""


class _StandardError(logging.Handler):
    """Lines on standard error, above a bar of progress where there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        if sys.stderr is not None:
            level = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
            Progress.write(f"raytac: {level}{record.getMessage()}", file=sys.stderr)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    0: done; 1: the doctor found the default job broken; 2: wrong input, or a full disk; 130: Ctrl-C; 141: nobody reads the output any
    more. After Ctrl-C it prints what stays, as ``shared.kept_if_interrupted`` says.
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
    except KeyboardInterrupt as stop:
        kept = "; ".join(getattr(stop, "__notes__", ())) or "nothing written"
        print(f"raytac: interrupted; {kept}", file=sys.stderr)
        return 130
    finally:
        log.removeHandler(shown)
        log.setLevel(before)
        warnings.formatwarning = formatted


def _run(args: Sequence[str]) -> int:
    if list(args) == ["--version"]:
        print(f"raytac {__version__}")
        return 0
    if not args or args[0] not in COMMANDS:
        return _overview(args)
    import tyro
    from tyro.constructors import ConstructorRegistry

    registry = ConstructorRegistry()
    registry.primitive_rule(_optional)
    module = _module_of(args[0])
    command = getattr(module, COMMANDS[args[0]][0])
    with registry:
        parsed = tyro.cli(command, prog=f"raytac {args[0]}", args=args[1:])
    return parsed.run()


def _module_of(command: str) -> Any:
    try:
        return importlib.import_module(f"raytac.cli.{command.replace('-', '_')}")
    except (ImportError, NameError) as error:  # Dr.Jit 1.5 hides the first behind the second
        if missing := library_missing():
            raise BackendError(missing) from error
        raise


def _optional(option: Any) -> Any:
    """Rule by which tyro reads ``T | None`` as T, so that help and errors name T alone."""
    from tyro.constructors import PrimitiveConstructorSpec

    kinds = [kind for kind in get_args(option.type) if kind is not NoneType]
    if NoneType not in get_args(option.type) or len(kinds) != 1 or kinds[0] not in (int, float, str, Path):
        return None
    kind = kinds[0]

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"must be a {'whole ' if kind is int else ''}number, not {words[0]!r}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: [str(value)],
    )


def _overview(args: Sequence[str]) -> int:
    """One line a command; exits with code 2 unless help was asked for."""
    lines = ["usage: raytac COMMAND [OPTIONS]", "", "Simulate GelSight tactile sensors.", ""]
    lines += [f"  {name:<17}{text}" for name, (_, text) in COMMANDS.items()]
    lines += ["", "raytac COMMAND --help lists its options; raytac --version tells which raytac this is."]
    if args and args[0] in ("-h", "--help"):
        print("\n".join(lines))
        return 0
    print("\n".join(lines), file=sys.stderr)
    given = {"value": args[0]} if args else {}
    error = InputError("command", rule="must be a known command" if args else "must be given", choices=COMMANDS, **given)
    print(f"raytac: error: {error}", file=sys.stderr)
    raise SystemExit(2)


def _drop_output() -> None:
    """Discard the rest of standard output, so that the interpreter ends without another error."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
