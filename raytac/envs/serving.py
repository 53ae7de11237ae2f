"""A vector of environments in a process of its own, which answers over a pipe; it needs no learner's library."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from raytac.envs.environments import TactileVectorEnv

__all__ = ["serve"]


def serve(pipe: Connection, kind: type[TactileVectorEnv], num_envs: int, options: dict[str, Any]) -> None:
    """Make the vector and answer until the pipe is closed.

    An order is ``("reset", seeds)`` or ``("step", actions)``; an answer is whether it went well, what the vector returned or the error that
    it raised, and where. The first answer comes unasked: observation and action space of one environment. Ctrl-C is left to the caller.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        env = kind(num_envs, **options)
        pipe.send((True, (env.single_observation_space, env.single_action_space), ""))
    except Exception as error:
        pipe.send((False, error, traceback.format_exc()))
        return
    orders: dict[str, Callable[[Any], Any]] = {"reset": lambda seeds: env.reset(seed=seeds), "step": env.step}
    while True:
        try:
            order, value = pipe.recv()
        except (EOFError, ConnectionResetError):
            return
        try:
            answer = True, orders[order](value), ""
        except Exception as error:
            answer = False, error, traceback.format_exc()
        try:
            pipe.send(answer)
        except (BrokenPipeError, ConnectionResetError):
            return
