"""Vectors of environments in processes, each with a world on one core."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from raytac.errors import InputError

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def one_thread() -> Iterator[None]:
    """Give processes that start within one thread of BLAS each; many processes share the cores."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when NumPy loads, so they must stand before a process starts
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class Workers:
    """Processes that each make one vector and reply to commands.

    Ctrl-C reaches the caller alone, and workers end with it.

    Attributes:
        each: number of environments of a process.
        made: what each process says of its vector, in the order of the processes.
    """

    def __init__(
        self, serve: Callable[..., None], kind: Callable[..., Any], num_envs: int, processes: int, seed: int, **options: Any
    ) -> None:
        """Start the processes; return once every vector is made.

        Args:
            serve: function that a process runs, with (pipe, kind, number of environments, options); see ``serve``.
            kind: what makes a vector.
            num_envs: number of environments in all, the same number in each process.
            seed: of process 0; process k has seed + k num_envs / processes, so that no two environments have the same random stream.
            options: of ``kind``; they must pickle.

        Raises:
            InputError: a number of environments that the processes cannot share evenly; as ``kind``.
        """
        if processes < 1 or num_envs < 1 or num_envs % processes:
            rule = f"must be a multiple of the number of processes, which is {processes} and must be at least 1"
            raise InputError("num_envs", value=num_envs, rule=rule)
        self.each = num_envs // processes
        context = multiprocessing.get_context("spawn")
        self._workers: list[tuple[Any, Connection]] = []
        with one_thread():
            for k in range(processes):
                mine, theirs = context.Pipe()
                arguments = theirs, kind, self.each, {**options, "seed": seed + k * self.each}
                worker = context.Process(target=serve, args=arguments, daemon=True, name=f"raytac-envs-{k}")
                worker.start()
                theirs.close()
                self._workers.append((worker, mine))
        self.made = self.replies()

    def __len__(self) -> int:
        return len(self._workers)

    def send(self, command: str, values: Sequence[Any]) -> None:
        """Send a command with one value to each process."""
        for (_, pipe), value in zip(self._workers, values, strict=True):
            pipe.send((command, value))

    def replies(self) -> list[Any]:
        """One reply of every process, all read before an error is raised, so none is left over."""
        replies = []
        for k, (worker, pipe) in enumerate(self._workers):
            try:
                replies.append(pipe.recv())
            except (EOFError, ConnectionResetError):
                replies.append((False, RuntimeError(f"process {k} ended by itself, exit code {worker.exitcode}"), ""))
        for k, (fine, value, where) in enumerate(replies):
            if not fine:
                name = f"environments {k * self.each} to {(k + 1) * self.each - 1}, in process {k}"
                value.add_note(f"raised by {name}:\n{where}")
                raise value
        return [value for _, value, _ in replies]

    def close(self) -> None:
        """End the processes."""
        for worker, pipe in self._workers:
            pipe.close()
            worker.join(timeout=5.0)
            if worker.is_alive():
                worker.terminate()
        self._workers = []


def serve(pipe: Connection, make: Callable[[], tuple[Any, dict[str, Callable[[Any], Any]]]]) -> None:
    """Make a vector in this process and reply to commands until the pipe is closed.

    ``make`` returns what the first reply holds, which is sent without a command, and the commands by name. A command is (name, value). A
    reply is (success, return value or error, traceback). Ctrl-C is left to the caller.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        made, commands = make()
        pipe.send((True, made, ""))
    except Exception as error:
        pipe.send((False, error, traceback.format_exc()))
        return
    while True:
        try:
            command, value = pipe.recv()
        except (EOFError, ConnectionResetError):
            return
        try:
            reply = True, commands[command](value), ""
        except Exception as error:
            reply = False, error, traceback.format_exc()
        try:
            pipe.send(reply)
        except (BrokenPipeError, ConnectionResetError):
            return
