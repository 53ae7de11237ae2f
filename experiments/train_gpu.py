"""``raytac train`` from a checkout: the same options and the same work (``raytac/learn/training.py``).

python experiments/train_gpu.py --task PushCube --touch markers+wrench --worlds mujoco_warp --num-envs 4096 --device cuda
"""

from __future__ import annotations

import sys

from raytac.cli import main

if __name__ == "__main__":  # processes of environments import this file too
    sys.exit(main(["train", *sys.argv[1:]]))
