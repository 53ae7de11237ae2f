"""Environments in threads: every one once, as a loop would have them, with a loop's error."""

from __future__ import annotations

import os
import threading

import mujoco
import numpy as np
import pytest

from raytac.world.engine.env_threads import EnvThreads

_BOXES = "".join(
    f'<body pos="{0.05 * i} 0 {0.1 + 0.11 * i}"><freejoint/><geom type="box" size=".05 .05 .05"/></body>' for i in range(6)
)
_PILE = f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{_BOXES}</worldbody></mujoco>'


@pytest.mark.parametrize(("threads", "envs"), [(1, 9), (3, 1), (3, 7), (3, 8), (3, 31), (64, 31)])
def test_every_environment_once_and_in_contiguous_parts(threads: int, envs: int) -> None:
    seen: dict[int, list[int]] = {}
    EnvThreads(threads).run(lambda b: seen.setdefault(threading.get_ident(), []).append(b), range(10, 10 + envs))
    assert sorted(b for part in seen.values() for b in part) == list(range(10, 10 + envs))
    parts = min(threads, envs // 4)
    assert len(seen) <= max(parts, 1)
    if parts < 2:
        assert list(seen) == [threading.get_ident()]
        assert seen[threading.get_ident()] == list(range(10, 10 + envs))


def test_the_caller_takes_a_part() -> None:
    """The first one; the others wait for threads, each of which takes one at least."""
    seen: dict[int, int] = {}
    EnvThreads(2).run(lambda b: seen.setdefault(b, threading.get_ident()), range(8))
    assert {seen[b] for b in range(4)} == {threading.get_ident()}
    assert {seen[b] for b in range(4, 8)}.isdisjoint({threading.get_ident()})


def test_states_of_mujoco_are_those_of_a_loop_to_the_bit() -> None:
    model, count = mujoco.MjModel.from_xml_string(_PILE), 13

    def fall(threads: int) -> list[mujoco.MjData]:
        datas, pool = [mujoco.MjData(model) for _ in range(count)], EnvThreads(threads)
        for b, data in enumerate(datas):
            data.qvel[:] = np.random.default_rng(b).normal(size=model.nv)
        for _ in range(200):
            pool.run(lambda b: mujoco.mj_step1(model, datas[b]), range(count))
            pool.run(lambda b: mujoco.mj_step2(model, datas[b]), range(count))
        return datas

    loop, divided = fall(1), fall(3)
    assert all(data.ncon for data in loop)  # the pile is one
    for one, other in zip(loop, divided, strict=True):
        for name in ("qpos", "qvel", "qacc", "qfrc_constraint"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_the_first_part_with_an_error_names_it_and_the_others_are_done() -> None:
    done = []

    def work(b: int) -> None:
        if b in (6, 9):
            raise ValueError(f"environment {b}")
        done.append(b)

    pool = EnvThreads(3)
    with pytest.raises(ValueError, match="environment 6"):
        pool.run(work, range(12))
    assert sorted(done) == [0, 1, 2, 3, 4, 5, 8]  # parts of four, each up to its error
    with pytest.raises(ValueError, match="environment 6"):
        pool.run(work, [6, *range(20, 31)])  # in the caller's part
    assert sorted(done)[-8:] == list(range(23, 31))
    pool.run(done.append, range(40, 52))  # and the threads still work
    assert sorted(done)[-12:] == list(range(40, 52))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:This process.*multi-threaded:DeprecationWarning")
def test_threads_are_started_again_after_a_fork() -> None:
    """As ``gymnasium.vector.AsyncVectorEnv`` forks: threads of the parent are not in the child."""
    pool, seen = EnvThreads(2), []
    pool.run(seen.append, range(8))
    child = os.fork()
    if child == 0:
        seen.clear()
        pool.run(seen.append, range(8))
        os._exit(len(seen))
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 8
